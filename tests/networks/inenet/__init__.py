"""INENet against its released code."""
