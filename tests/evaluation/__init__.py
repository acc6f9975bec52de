"""Tests of `dbdnet_jax.evaluation.run`."""
