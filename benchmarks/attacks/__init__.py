"""Attacks on `align` and on the files it reads; see `__main__`."""
