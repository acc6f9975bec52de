"""Results as files: transforms, clouds, and JSON."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.align import Alignment
from dbdnet_jax.io.files import write_atomic


def transform_file(path: Path, alignment: Alignment) -> bytes:
    """What a file of that name holds: the 4x4 matrix as text or ``.npy``, or `as_json`."""
    buffer = io.BytesIO()
    if path.suffix.lower() == ".json":
        buffer.write((json.dumps(as_json(alignment), indent=2) + "\n").encode())
    elif path.suffix.lower() == ".npy":
        np.save(buffer, alignment.transform)
    else:
        np.savetxt(buffer, alignment.transform, fmt="%.17g")
    return buffer.getvalue()


def ply_file(points: Float[np.ndarray, "n 3"]) -> bytes:
    """Points as a binary PLY in float64."""
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    return head.encode() + np.ascontiguousarray(points, "<f8").tobytes()


def write_ply(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    """Write `ply_file`, whole or not at all."""
    write_atomic(path, ply_file(points))


def as_json(alignment: Alignment) -> dict[str, Any]:
    """The numbers of an alignment without its long arrays; no NaN and no infinity."""
    return {
        "transform": alignment.transform.tolist(),
        "valid": alignment.valid,
        "reason": alignment.reason,
        "success_probability": alignment.success_probability,
        "warnings": list(alignment.warnings),
        "inlier_ratio": alignment.inlier_ratio,
        "inlier_distance": alignment.inlier_distance,
        "rmse": alignment.rmse if np.isfinite(alignment.rmse) else None,
        "information": alignment.information.tolist(),
        "pivot": alignment.pivot.tolist(),
        "alternatives": [
            other._asdict() | {"transform": other.transform.tolist()}
            for other in alignment.alternatives
        ],
        "seconds": alignment.timings,
    }
