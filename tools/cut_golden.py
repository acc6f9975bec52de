"""Cut the released code's outputs down to a file that every clone can hold.

    python -m tools.cut_golden ../shared/golden/released_tiny.npz

Writes tests/fixtures/released_cut.npz (1.5 MB of 5.8): the inputs, the overlap network whole, the
registration network without the PointNet that sets its four parameters (three quarters of all
weights), and the outputs of the first pair, of large matrices every sixteenth row. In place of that
PointNet stand its four outputs: those in the file for the registration alone, and for the whole
network what our own gives, which the full file's tests hold against theirs.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

TARGET = Path(__file__).parents[1] / "tests" / "fixtures" / "released_cut.npz"
STEP = 16  # rows of a correspondence matrix, of which one is kept
POINTNET = "RegNet.weight_net."
UNUSED = ("self_attention", "self_layer_norm", "cross_attention", "cross_layer_norm")


def cut(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays to keep, those of stacked pairs cut to the first pair."""
    kept = {}
    for name, array in arrays.items():
        group, _, rest = name.partition("/")
        if POINTNET in name or rest.removeprefix("overlap_predictor.").startswith(UNUSED):
            continue
        if rest.startswith("1/") and group in ("registration", "end_to_end"):
            continue
        if "correspondence" in name:
            array = array[::STEP]
        elif group == "overlap" and "grad_norm" not in name and "loss" not in name:
            array = array[:1]
        elif name == "registration/loss_trajectory":
            array = array[:1]  # the later steps move the PointNet too
        kept[name] = array
    return kept


def end_to_end_parameters(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(4,) what our PointNet makes of the first pair's points that the released code kept."""
    from dbdnet_jax.networks.dbdnet.registration import ParameterNetwork
    from dbdnet_jax.networks.dbdnet.released import from_released
    from dbdnet_jax.types import Cloud

    names = "state_dict/"
    state = {k.removeprefix(names): x for k, x in arrays.items() if k.startswith(names)}
    params = from_released(state)
    variables = {"params": jax.tree.map(np.float64, params.registration["weight_net"])}
    clouds = ("source", "target")
    rows = [arrays[cloud][0][arrays[f"end_to_end/0/{cloud}_index"]] for cloud in clouds]
    n = max(map(len, rows))
    points = np.stack([np.vstack([x, np.zeros((n - len(x), 3))]) for x in rows])
    with jax.enable_x64(True):
        both = Cloud(jax.numpy.asarray(points), jax.numpy.asarray([len(x) for x in rows]))
        beta_r, alpha_r, beta_t, alpha_t = ParameterNetwork(params.config).apply(variables, both)
    return np.array([beta_r, alpha_r, beta_t, alpha_t])


def pack(
    arrays: dict[str, np.ndarray], absent: dict[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """One member for each type, as byte planes, which compress better than interleaved bytes."""
    index = {"absent": {name: list(shape) for name, shape in absent.items()}, "arrays": {}}
    packed = {}
    for dtype in sorted({x.dtype.str for x in arrays.values()}):
        same = {name: x for name, x in arrays.items() if x.dtype.str == dtype}
        index["arrays"][dtype] = [[name, list(x.shape)] for name, x in same.items()]
        flat = np.concatenate([x.ravel() for x in same.values()])
        packed[dtype] = flat.view(np.uint8).reshape(len(flat), -1).T
    return {"index": np.array(json.dumps(index)), **packed}


def main() -> None:
    """Write the file."""
    arrays = dict(np.load(sys.argv[1]))
    kept = cut(arrays)
    kept["end_to_end/0/parameters"] = end_to_end_parameters(arrays)
    absent = {name: x.shape for name, x in arrays.items() if f"state_dict/{POINTNET}" in name}
    np.savez_compressed(TARGET, **pack(kept, absent))
    print(f"{TARGET}: {len(kept)} of {len(arrays)} arrays, {TARGET.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
