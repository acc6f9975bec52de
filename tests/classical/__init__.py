"""Tests of `dbdnet_jax.classical`."""
