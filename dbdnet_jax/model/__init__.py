"""The networks: flax.linen modules that hold parameters and call the operations."""
