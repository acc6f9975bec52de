"""Tests of `dbdnet_jax.metrics.pose`."""
