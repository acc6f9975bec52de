"""Tests of the operations, against `tests/oracle.py` and libraries from outside."""
