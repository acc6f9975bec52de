"""Tests of `dbdnet_jax.cli`."""
