"""Mean and deviation of the local invariants over noisy training clouds, as `ops` states them.

python -m tools.measure_local_geometry
"""

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.ops.local_geometry import FEATURES, RADII, local_invariants

SEED = 5


def main() -> None:
    """Print both tables, a row for each radius."""
    shapes = cad_split("train")

    @jax.jit
    def measure(number, points):
        key = jax.random.fold_in(jax.random.key(SEED), number)
        cloud = make_pair(key, points, jnp.zeros_like(points), Protocol()).source
        return local_invariants(cloud.points, cloud.count, len(RADII))

    found = np.concatenate([measure(i, points) for i, points in enumerate(shapes.points)])
    for name, values in (("MEAN", found.mean(axis=0)), ("SPREAD", found.std(axis=0))):
        print(f"{name} = (")
        for row in values.reshape(-1, FEATURES):
            print(f"    ({', '.join(f'{value:.4g}' for value in row)}),")
        print(")")


if __name__ == "__main__":
    main()
