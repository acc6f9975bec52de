"""Tests of `dbdnet_jax.networks.masknet`."""
