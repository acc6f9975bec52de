"""What the released code computed in float64, and how near it ours must come.

The file holds its large arrays rounded to float32, so they are compared to a millionth of their
scale. Every clone has a part of it, written by `tools.cut_golden`; the whole is used where it is.
"""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.released import from_released
from dbdnet_jax.networks.params import Params
from dbdnet_jax.types import Cloud, Pair, Rigid
from tests.conftest import Tolerance
from tools.cut_golden import POINTNET, STEP

CUT = Path(__file__).parent / "fixtures" / "released_cut.npz"
FILE = Path(__file__).parents[2] / "shared" / "golden" / "released_tiny.npz"
IS_WHOLE = FILE.exists()
MARKS = [pytest.mark.usefixtures("x64")]
whole_file_only = pytest.mark.skipif(
    not IS_WHOLE,
    reason="needs ../shared/golden: the part of it in tests/fixtures has no such array",
)
ROWS = slice(None, None, 1 if IS_WHOLE else STEP)  # of a correspondence matrix, those in the file

NEIGHBOURS = 8
N = 320
CLOUDS = ("source", "target")
PAIRS = pytest.mark.parametrize("b", [0, 1] if IS_WHOLE else [0])

# Poses are stored in float64.
POSE = Tolerance(rtol=0.0, atol=1e-7)
# Stored rounded to float32: half of its eps.
LOSS = Tolerance(rtol=1e-7, atol=0.0)
# The biases of each branch's last norm move both clouds' features alike, which distances do not
# see: rounding leaves about 1e-16.
GRADIENT_NORM = Tolerance(rtol=1e-5, atol=1e-14)
# Adam divides by the gradients' size: a difference of theirs is carried from step to step.
TRAJECTORY = Tolerance(rtol=1e-5, atol=0.0)


@functools.cache
def golden() -> dict[str, np.ndarray]:
    """The file's arrays, widened to float64."""
    arrays = dict(np.load(FILE)) if IS_WHOLE else read_cut()
    return {k: x.astype(np.float64) if x.dtype.kind == "f" else x for k, x in arrays.items()}


def read_cut() -> dict[str, np.ndarray]:
    """The part in the repository; parameters that it leaves out are zeros."""
    packed = np.load(CUT)
    index = json.loads(str(packed["index"]))
    arrays = {name: np.zeros(shape, np.float32) for name, shape in index["absent"].items()}
    for dtype, members in index["arrays"].items():
        flat = np.ascontiguousarray(packed[dtype].T).view(dtype).ravel()
        ends = np.cumsum([np.prod(shape, dtype=int) for _, shape in members])
        for (name, shape), part in zip(members, np.split(flat, ends[:-1]), strict=True):
            arrays[name] = part.reshape(shape)
    return arrays


def below(prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names start with ``prefix``, by the rest of their names."""
    return {k.removeprefix(prefix): x for k, x in golden().items() if k.startswith(prefix)}


def released_params(*, override: bool = False) -> Params:
    """The released parameters in float64; ``override`` replaces the last overlap layer.

    Where the file has no PointNet, its last layer gives the first pair's four numbers by itself:
    those of the whole network with ``override``, which only its tests use.
    """
    state = below("state_dict/") | (below("end_to_end/override/") if override else {})
    if not IS_WHOLE:
        four = golden()[f"{'end_to_end' if override else 'registration'}/0/parameters"]
        state[f"{POINTNET}pre_parameter_layer.9.bias"] = np.log(np.expm1(four))
    params = from_released(state, k=NEIGHBOURS)
    return jax.tree.map(lambda x: x.astype(jnp.float64), params)


def whole(points) -> Cloud:
    """A cloud without padding."""
    return Cloud(jnp.asarray(points), jnp.asarray(len(points)))


def clouds(b: int) -> tuple[Cloud, Cloud]:
    return whole(golden()["source"][b]), whole(golden()["target"][b])


def true_masks(b: int) -> tuple[jax.Array, jax.Array]:
    return jnp.asarray(golden()["source_mask_gt"][b]), jnp.asarray(golden()["target_mask_gt"][b])


def pairs(*numbers: int) -> Pair:
    """The pairs of these numbers, stacked."""
    arrays, b = golden(), list(numbers)
    count = jnp.full(len(b), N)
    source, target = jnp.asarray(arrays["source"][b]), jnp.asarray(arrays["target"][b])
    truth = jnp.asarray(arrays["rotation_gt"][b]), jnp.asarray(arrays["translation_gt"][b])
    return Pair(
        Cloud(source, count),
        Cloud(target, count),
        Rigid(*truth),
        jnp.asarray(arrays["source_mask_gt"][b] > 0.5),
        jnp.asarray(arrays["target_mask_gt"][b] > 0.5),
        jnp.zeros_like(source),
        jnp.zeros_like(target),
    )
