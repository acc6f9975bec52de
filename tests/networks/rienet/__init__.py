"""RIENet against its released code."""
