"""Tests of the readers of points, one file a format."""
