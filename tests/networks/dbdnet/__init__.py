"""Tests of `dbdnet_jax.networks.dbdnet`."""
