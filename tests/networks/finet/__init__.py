"""FINet against its released code."""
