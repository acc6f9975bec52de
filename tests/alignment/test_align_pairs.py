"""Many pairs: the answers of `align`, each once, and what is wrong with one costs that one."""

from concurrent.futures import ThreadPoolExecutor

import pytest

import dbdnet_jax
from dbdnet_jax.alignment.align_pairs import align_pairs
from dbdnet_jax.alignment.writing import write_ply
from tests.aligning import POINTS, pair, rotation_error_deg, tiny_params

OPTIONS = {"max_points": POINTS, "search": "near", "refine": False}


def check(results, truth) -> None:
    """The pair, the same as files, a missing file and two points."""
    results = list(results)
    assert len(results) == 4
    results = {result.number: result for result in results}
    for i in (0, 1):
        assert results[i].failure is None
        assert rotation_error_deg(results[i].alignment.transform, truth) < 2
    assert [results[i].alignment for i in (2, 3)] == [None, None]
    assert results[2].failure.kind == "input" and "none.ply" in results[2].failure.message
    assert "at least 16 points" in results[3].failure.message


@pytest.fixture
def clouds(tmp_path):
    """Four pairs of which two are sound, and the truth of these."""
    source, target, truth = pair()
    write_ply(tmp_path / "a.ply", source)
    write_ply(tmp_path / "b.ply", target)
    files = (tmp_path / "a.ply", tmp_path / "b.ply")
    pairs = [(source, target), files, (tmp_path / "none.ply", target), (source[:2], target)]
    return pairs, truth


def test_processes_of_our_own_align(clouds, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "2")  # as here, so that they share kept programs
    pairs, truth = clouds
    dbdnet_jax.save_params(tmp_path / "tiny.npz", tiny_params())
    options = {**OPTIONS, "initial": truth}
    check(align_pairs(iter(pairs), tmp_path / "tiny.npz", jobs=1, **options), truth)


def test_an_executor_that_is_given_aligns_with_a_network_that_is_given(clouds):
    pairs, truth = clouds
    options = {**OPTIONS, "initial": truth}
    with ThreadPoolExecutor(1) as executor:
        check(align_pairs(pairs, tiny_params(), executor=executor, **options), truth)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"serach": "near"}, TypeError, "serach"),
        ({"search": "all"}, ValueError, "search must be one of auto, near, any; got 'all'"),
        ({"initial": 3}, ValueError, "initial must be 4x4"),
        ({"jobs": 0}, ValueError, "jobs must be at least 1; got 0"),
        ({"in_flight": -1}, ValueError, "in_flight must be at least 1; got -1"),
        ({"jobs": 2, "executor": ThreadPoolExecutor()}, ValueError, "jobs must not be given"),
    ],
)
def test_what_is_of_no_use_is_refused_before_any_work(options, error, message):
    with pytest.raises(error, match=message):
        align_pairs([], **options)
