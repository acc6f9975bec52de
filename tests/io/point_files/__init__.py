"""Tests of `dbdnet_jax.io.point_files`."""
