"""What `polish` makes of true poses that were perturbed, on validation pairs of the CAD shapes.

    python -m benchmarks.polish

Poses are turned by 2 to 30 degrees about the moved source's centroid and shifted by 0.05 to 0.1.
A row for each protocol, method and angle: mean and median rotation error in degrees, mean
translation error, processor seconds of a pair (compilation apart).
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.metrics import motion_errors
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.sampling import random_direction
from dbdnet_jax.polish import choose, polish
from dbdnet_jax.types import Pair, Rigid

PROTOCOLS = {"noise": Protocol(), "noise, disjoint": Protocol(disjoint=True)}
ANGLES_DEG = (2.0, 5.0, 10.0, 20.0, 30.0)
TURNS_DEG = (-25.0, 25.0)  # about each axis, of the seven starts
WRONG_LABELS = 0.2  # part of the overlap labels that are turned over


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
    """`polish` on the clouds alone."""
    return polish(pair.source, pair.target, start).target_from_source


def with_overlap(pair: Pair, start: Rigid) -> Rigid:
    """`polish` with overlap labels of which a fifth are wrong, as probabilities 0.95 and 0.05."""
    wrong = jax.random.bernoulli(jax.random.key(0), WRONG_LABELS, (2, len(pair.source_overlap)))
    overlaps = [
        jnp.where(label ^ flipped, 0.95, 0.05)
        for label, flipped in zip((pair.source_overlap, pair.target_overlap), wrong, strict=True)
    ]
    return polish(pair.source, pair.target, start, *overlaps, first_radius=0.3).target_from_source


def seven_starts(pair: Pair, start: Rigid) -> Rigid:
    """`choose` among the polished start and its polished turns."""
    turns = [rigid.rotation_about(axis, jnp.deg2rad(a)) for axis in jnp.eye(3) for a in TURNS_DEG]
    poses = [start, *(turned(start, pair, turn) for turn in turns)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses)
    polished = jax.lax.map(lambda pose: plain(pair, pose), stacked)
    return choose(pair.source, pair.target, polished)


METHODS = {
    "start": lambda pair, start: start,
    "polish": plain,
    "polish, overlap 80 % right": with_overlap,
    "polish, seven starts": seven_starts,
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
                    f"{name:16s} {method:28s} {degrees:4.0f} deg: {angle.mean():6.2f} "
                    f"{np.median(angle):6.2f} {errors.translation.mean():6.3f} {seconds:7.4f} s"
                )


if __name__ == "__main__":
    main()
