"""DCP against its released code."""
