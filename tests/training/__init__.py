"""Tests of `dbdnet_jax.training.loop`."""
