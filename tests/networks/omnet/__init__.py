"""OMNet against its released code."""
