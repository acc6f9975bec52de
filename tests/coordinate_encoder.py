"""Runs a script of the project with an encoder that compiles at once; all else is as it is.

python -m tests.coordinate_encoder train.py --config=...
"""

import runpy
import sys

import flax.linen as nn
import jax.numpy as jnp

from dbdnet_jax.networks.dbdnet import overlap, registration


class CoordinateEncoder(nn.Module):
    """A feature is where a point is, repeated; the encoder's own parameters are left alone."""

    channels: int
    space: str

    def __call__(self, points, pyramid, geometry=None):
        """(n, 4 channels), as the encoder's."""
        return jnp.tile(points, (1, 2 * self.channels))[:, : 4 * self.channels]


if __name__ == "__main__":
    overlap.Encoder = registration.Encoder = CoordinateEncoder
    sys.argv = sys.argv[1:]
    runpy.run_path(sys.argv[0], run_name="__main__")
