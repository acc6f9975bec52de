"""What no method can know: the turn of a shape of revolution about its axis.

    python -m benchmarks.symmetry

Prints how many CAD test shapes a turn brings onto themselves, and the mean rotation error on the
frozen noisy test pairs of a method that knows every pose but for that turn, and then guesses the
smallest rotation, which is the likeliest under the protocol. The surface does not tell that turn;
where points of the shape stand in both clouds, as under the paper's protocol, their pattern does.
"""

import collections

import numpy as np

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.data.symmetry import Turn, smallest_turn

OF_REVOLUTION_DEG = 45.0  # shapes with a turn as small as this count as shapes of revolution


def unknown_turn_deg(rotation: np.ndarray, axis: np.ndarray) -> float:
    """The angle about ``axis`` between a rotation and the smallest of those that differ by it."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    along = axis @ rotation @ axis
    angle = np.arctan2(np.trace(cross @ rotation), np.trace(rotation) - along)
    return abs(float(np.degrees(angle)))


def main() -> None:
    """Judge every test shape, then every test pair."""
    turns = [smallest_turn(points) for points in cad_split("test").points]
    counts = collections.Counter("none" if turn is None else turn.degrees for turn in turns)
    print("test shapes by their smallest turn in degrees:", dict(counts))
    pairs, digest = cad_test_pairs("noise")
    errors = []
    for i, rotation in enumerate(np.asarray(pairs.target_from_source.rotation, np.float64)):
        turn = turns[i % len(turns)]  # frozen sets take shapes in turn
        free = isinstance(turn, Turn) and turn.degrees <= OF_REVOLUTION_DEG
        errors.append(unknown_turn_deg(rotation, turn.axis) if free else 0.0)
    affected = np.array(errors)[np.array(errors) > 0]
    print(f"{len(affected)} of {len(errors)} test pairs (sha256 {digest[:8]}) are of such shapes")
    print(
        f"mean error of the turn: {affected.mean():.1f} deg there, {np.mean(errors):.2f} over all"
    )


if __name__ == "__main__":
    main()
