"""Clouds of any size go through a few compiled programs."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.alignment import pose_programs
from dbdnet_jax.classical.refine import Refined
from dbdnet_jax.io import programs
from dbdnet_jax.io.files import warn_without_cache
from dbdnet_jax.ops.sampling import prefix_mask
from dbdnet_jax.types import Branch, Registration, Rigid
from tests.aligning import tiny_params
from tests.conftest import random_cloud
from tests.test_structure import imported_names

NOT_TRACED = {"programs", "files", "forks", "surfaces", "transforms", "errors"}
EXAMPLES = Path(__file__).parents[2] / "examples"
BUCKETS = {192, 384, 768, 1536}


def answer_nothing(params, source, target) -> Registration:
    """A stand-in for `register_clouds`: the right shapes, at no cost."""
    n, m = len(source.points), len(target.points)
    masks = prefix_mask(n, source.count), prefix_mask(m, target.count)
    branch = Branch(jnp.zeros((n, m)), jnp.zeros((n, 3)), jnp.zeros(n))
    return Registration(
        rotation=jnp.eye(3),
        translation=jnp.zeros(3),
        src_overlap=masks[0].astype(float),
        tgt_overlap=masks[1].astype(float),
        src_kept=masks[0],
        tgt_kept=masks[1],
        rotation_branch=branch,
        translation_branch=branch,
        confidence=jnp.zeros(n),
        valid=source.count > 0,
    )


def test_a_kept_program_depends_on_every_file_that_it_is_traced_through():
    package = Path(programs.__file__).parents[1]
    hashed = {path for name in programs.TRACED for path in package.glob(name)}
    reached, waiting = set(), [package / "alignment" / "pose_programs.py"]
    while waiting:
        path = waiting.pop()
        names = [name.split(".") for name in imported_names(path, package.parent)]
        files = {
            package.parent.joinpath(*part).with_suffix(".py") for x in names for part in (x, x[:-1])
        }
        found = {file for file in files - reached if file.is_file() and file.stem not in NOT_TRACED}
        reached |= found
        waiting += found
    assert package / "classical" / "refine.py" in reached
    assert reached <= hashed


def test_fifty_sizes_are_traced_as_often_as_there_are_buckets(monkeypatch):
    networks, refinements = [], []

    def register_clouds(params, source, target):
        networks.append((len(source.points), len(target.points)))
        return answer_nothing(params, source, target)

    @jax.jit
    def refine(source, target, start, cap):
        refinements.append((len(source.points), len(target.points)))
        return Refined(Rigid(*start), jnp.zeros(()), jnp.ones((), bool))

    monkeypatch.setattr(pose_programs, "register_clouds", register_clouds)
    monkeypatch.setattr(pose_programs.em_icp, "refine", refine)
    monkeypatch.setattr(pose_programs, "_PROGRAMS", {})
    # Not through files: the stand-in must not be kept as the network's program.
    monkeypatch.setattr(pose_programs, "load_or_trace", lambda function, *rest: jax.jit(function))
    for n, m in np.random.default_rng(0).integers(16, max(BUCKETS) + 1, (50, 2)):
        source, target = random_cloud(n, n), random_cloud(m, m)
        proposal = pose_programs.predict_pose(tiny_params(), source, target)
        assert proposal.mass.shape == (n, m)
        assert proposal.source_overlap.all() and proposal.target_overlap.all()
        pose_programs.refine(proposal.transform, source, target)
    for traces in (networks, refinements):
        assert len(traces) == len(set(traces)) <= len(BUCKETS)
        assert {size for pair in traces for size in pair} <= BUCKETS


def test_two_functions_of_equal_arguments_are_two_programs(monkeypatch):
    monkeypatch.setattr(pose_programs, "_PROGRAMS", {})
    one, two = (pose_programs._run(f"add {k}", lambda x, k=k: x + k, jnp.ones(3)) for k in (1, 2))
    assert (two - one == 1).all()


@pytest.fixture
def keep_in():
    """Tell JAX of another folder for programs, for one test."""
    before = jax.config.values["jax_compilation_cache_dir"]
    yield lambda folder: jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def kept(tmp_path, keep_in):
    """A folder where programs are kept, and how often one was traced."""
    keep_in(str(tmp_path))
    traced = []

    def run():
        def double(x):  # a new one each time: JAX itself remembers what it has traced
            traced.append(1)
            return 2 * x

        answer = programs.load_or_trace(double, "double", jnp.ones(3))(jnp.ones(3))
        assert (answer == 2).all()
        return len(traced)

    return tmp_path, run


def entry(folder: Path) -> Path:
    (path,) = folder.glob("*.stablehlo")
    return path


def test_a_kept_program_is_not_traced_again(kept):
    folder, run = kept
    assert run() == run() == 1 and entry(folder).is_file()


@pytest.mark.parametrize("where", [0, 40, -1])
def test_a_damaged_program_is_made_again(kept, where):
    folder, run = kept
    run()
    whole = entry(folder).read_bytes()
    flipped = bytearray(whole)
    flipped[where] ^= 1
    for times, damaged in enumerate((bytes(flipped), b"", whole[:-9], b"x" * 99, whole + b"x"), 2):
        entry(folder).write_bytes(damaged)
        assert run() == times
        assert run() == times  # kept again


def test_a_folder_in_place_of_a_program_and_a_full_disk_cost_a_warning(kept, keep_in):
    folder, run = kept
    run()
    path = entry(folder)
    path.unlink()
    path.mkdir()
    warn_without_cache.cache_clear()
    with pytest.warns(RuntimeWarning, match="nothing is kept for the next run"):
        assert run() == 2
    keep_in("/dev/null/below")
    warn_without_cache.cache_clear()
    with pytest.warns(RuntimeWarning, match="nothing is kept"):
        assert run() == 3


def test_another_precision_is_another_program(kept):
    folder, run = kept
    run()
    with jax.enable_x64(True):
        run()
    with jax.default_matmul_precision("highest"):
        run()
    assert len(list(folder.glob("*.stablehlo"))) == 3


def test_the_time_of_loading_is_known(kept):
    before = programs.loading_seconds()
    kept[1]()
    assert programs.loading_seconds() > before


def test_entries_of_jax_that_are_not_whole_are_deleted(tmp_path):
    whole = zlib.compress(bytes(range(256)) * 9)
    held = {"whole": whole, "empty": b"", "half": whole[:-3], "odd": b"odd", "long": whole + b"x"}
    held["flipped"] = whole[:20] + bytes([whole[20] ^ 1]) + whole[21:]
    held["zstandard"] = b"\x28\xb5\x2f\xfd?"
    for name, data in held.items():
        (tmp_path / f"{name}-cache").write_bytes(data)
    programs._drop_damaged(tmp_path)
    assert {path.name for path in tmp_path.glob("*-cache")} == {"whole-cache", "zstandard-cache"}


def test_whole_entries_are_unpacked_once_and_again_when_they_change(tmp_path, monkeypatch):
    first, second = (tmp_path / f"{name}-cache" for name in ("first", "second"))
    for path in (first, second):
        path.write_bytes(zlib.compress(b"program"))
    looked, is_deflated = [], programs._is_deflated
    monkeypatch.setattr(
        programs, "_is_deflated", lambda data: looked.append(data) or is_deflated(data)
    )
    programs._drop_damaged(tmp_path)
    programs._drop_damaged(tmp_path)
    assert len(looked) == 2
    second.write_bytes(second.read_bytes()[:-1])
    programs._drop_damaged(tmp_path)
    assert len(looked) == 3 and first.exists() and not second.exists()
    for note in (b"{", b"[]", b'{"first-cache": 3}'):
        (tmp_path / "whole.json").write_bytes(note)
        programs._drop_damaged(tmp_path)
    assert len(looked) == 6 and first.exists()


@pytest.mark.parametrize("given", [None, "/dev/null/below"])
def test_no_folder_for_programs_is_said_and_none_is_used(given, keep_in, monkeypatch):
    keep_in(given)
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    shortest = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    warn_without_cache.cache_clear()
    with pytest.warns(RuntimeWarning, match="nothing is kept for the next run"):
        programs.keep_compiled_programs()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", shortest)
    assert jax.config.values["jax_compilation_cache_dir"] is None


def test_a_platform_that_is_not_there_is_one_line():
    done = subprocess.run(
        [sys.executable, "-m", "dbdnet_jax", *map(str, EXAMPLES.glob("*.ply"))],
        capture_output=True,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "cuda"},
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "error: JAX_PLATFORMS must name platforms that this machine has; got" in done.stderr


def test_an_entry_that_vanishes_is_no_fault(tmp_path):
    (tmp_path / "a-cache").symlink_to(tmp_path / "gone")  # as if unlinked after the listing
    (tmp_path / "b-cache").write_bytes(b"damaged")
    programs._drop_damaged(tmp_path)
    assert not (tmp_path / "b-cache").exists()
