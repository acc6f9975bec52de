"""Tests of `dbdnet_jax.data.procedural.shapes`."""
