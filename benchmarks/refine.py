"""What `refine` makes of true poses that were perturbed, on validation pairs of the CAD shapes.

    python -m benchmarks.refine

Poses are turned by 2 to 30 degrees about the moved source's centroid and shifted by 0.05 to 0.1.
A row for each protocol, method and angle: mean and median rotation error in degrees, mean
translation error, processor seconds of a pair (compilation apart).
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.classical.refine import refine, refine_multistart
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.metrics.pose import motion_errors
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.sampling import random_direction
from dbdnet_jax.types import Pair, Rigid

PROTOCOLS = {"noise": Protocol(), "noise, disjoint": Protocol(disjoint=True)}
ANGLES_DEG = (2.0, 5.0, 10.0, 20.0, 30.0)


def draw_pairs(protocol: Protocol) -> Pair:
    """One pair of every validation shape, stacked."""
    shapes = cad_split("val")
    keys = jax.random.split(jax.random.key(11), len(shapes))
    draw = jax.vmap(lambda key, points, normals: make_pair(key, points, normals, protocol))
    return jax.jit(draw)(keys, shapes.points, shapes.normals)


def turned(pose: Rigid, pair: Pair, rotation: Float[Array, "3 3"]) -> Rigid:
    """The pose, then a rotation about the moved source's centroid."""
    centre = rigid.apply(pose, pair.source.points).mean(axis=0)
    return rigid.compose(Rigid(rotation, centre - rotation @ centre), pose)


def perturbed(key: PRNGKeyArray, pair: Pair, degrees: Float[Array, ""]) -> Rigid:
    """The true pose, turned about a random axis and shifted by 0.05 to 0.1."""
    axis_key, shift_key, length_key = jax.random.split(key, 3)
    rotation = rigid.rotation_about(random_direction(axis_key), jnp.deg2rad(degrees))
    pose = turned(pair.target_from_source, pair, rotation)
    length = jax.random.uniform(length_key, minval=0.05, maxval=0.1)
    return pose._replace(translation=pose.translation + length * random_direction(shift_key))


def plain(pair: Pair, start: Rigid) -> Rigid:
    """`refine` of one pose."""
    return refine(pair.source, pair.target, start).target_from_source


def from_turns(pair: Pair, start: Rigid) -> Rigid:
    """Of the refined pose and its refined turns the one that fits clearly better."""
    return refine_multistart(pair.source, pair.target, start).target_from_source


METHODS = {
    "start": lambda pair, start: start,
    "refine": plain,
    "refine_multistart": from_turns,
}


def main() -> None:
    """Print the table."""
    for name, protocol in PROTOCOLS.items():
        pairs = draw_pairs(protocol)
        keys = jax.random.split(jax.random.key(5), len(pairs.source.count))
        for method, function in METHODS.items():

            def run(pairs, keys, degrees, function=function):
                def one(arguments):
                    pair, key = arguments
                    found = function(pair, perturbed(key, pair, degrees))
                    return motion_errors(found, pair.target_from_source)

                return jax.lax.map(one, (pairs, keys))

            program = jax.jit(run).lower(pairs, keys, jnp.float32(0)).compile()
            for degrees in ANGLES_DEG:
                start = time.process_time()
                errors = jax.device_get(program(pairs, keys, jnp.float32(degrees)))
                seconds = (time.process_time() - start) / len(keys)
                angle = errors.rotation_deg
                print(
                    f"{name:16s} {method:8s} {degrees:4.0f} deg: {angle.mean():6.2f} "
                    f"{np.median(angle):6.2f} {errors.translation.mean():6.3f} {seconds:7.4f} s"
                )


if __name__ == "__main__":
    main()
