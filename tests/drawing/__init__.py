"""Tests of `dbdnet_jax.drawing`."""
