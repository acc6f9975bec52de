"""Files: written whole or not at all, read without executing anything, kept programs, clouds."""
