"""Measurements too long for the tests; each prints what it ran on."""
