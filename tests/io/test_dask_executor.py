"""A Dask cluster of two worker processes, one of which is killed on the way."""

import sys

import pytest

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.io.dask_executor import open_dask
from dbdnet_jax.io.workers import run_through
from tests.dask_cluster import cluster, square_slowly

COUNT = 60


def test_every_item_is_answered_once_though_a_worker_is_killed(tmp_path):
    pytest.importorskip("distributed", reason="the dask extra is not installed")
    found = []
    with cluster(tmp_path) as (address, workers), open_dask(address) as (executor, room):
        assert room >= 4
        for number, (square, process) in run_through(executor, square_slowly, range(COUNT), 8):
            found.append((number, square, process))
            if {x.pid for x in workers} <= {x[2] for x in found}:  # both have worked
                workers[0].kill()
    assert sorted(x[:2] for x in found) == [(i, i * i) for i in range(COUNT)]
    last = {x[2] for x in found[-20:]}
    assert last == {workers[1].pid}


def test_a_missing_library_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask", None)
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    with pytest.raises(MissingExtraError, match=r'pip install "dbdnet_jax\[dask\]"'):
        with open_dask("127.0.0.1:1"):
            pass
