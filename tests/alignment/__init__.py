"""Tests of `dbdnet_jax.alignment`."""
