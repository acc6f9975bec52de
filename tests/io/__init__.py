"""Tests of `dbdnet_jax.io`."""
