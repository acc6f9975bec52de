"""Overlap labels of large clouds: against all distances, in little memory, safely on disk."""

import tracemalloc

import numpy as np
import pytest

from dbdnet_jax.data.overlap import nearest_within, overlap_labels
from tests.data.threedmatch_folder import closer_than, room


def test_interrupted_write_leaves_no_file_to_be_read(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    clouds = rng.uniform(size=(100, 3)), rng.uniform(size=(90, 3))

    def stop(stream, **arrays):
        stream.write(b"half")
        raise OSError("no space left")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        patch.setattr(np, "savez_compressed", stop)
        overlap_labels(*clouds, 0.1, tmp_path)
    assert not list(tmp_path.glob("*.npz"))
    source, target = overlap_labels(*clouds, 0.1, tmp_path)
    np.testing.assert_array_equal(source, closer_than(*clouds, 0.1))
    np.testing.assert_array_equal(target, closer_than(*clouds[::-1], 0.1))
    assert len(list(tmp_path.glob("*.npz"))) == 1


def test_overlap_of_60000_points_needs_no_distance_matrix():
    rng = np.random.default_rng(0)
    source, target = room(rng, 60_000), room(rng, 60_000)
    tracemalloc.start()
    near, row = nearest_within(source, target, 0.0375)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # the matrix would have 14 GB even in float32
    rows = rng.integers(0, len(source), 50)
    np.testing.assert_array_equal(near[rows], closer_than(source[rows], target, 0.0375))
    distance = np.linalg.norm(source[rows][:, None] - target, axis=-1)
    np.testing.assert_array_equal(row[rows][near[rows]], distance.argmin(1)[near[rows]])
