"""Clouds of any size go through a few compiled programs."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.alignment import search
from dbdnet_jax.classical.refine import Refined
from dbdnet_jax.io import programs
from dbdnet_jax.ops.sampling import prefix_mask
from dbdnet_jax.types import Branch, Registration, Rigid
from tests.aligning import tiny_params
from tests.conftest import random_cloud
from tests.test_structure import imported_names

NOT_TRACED = {"programs", "files", "safe_pickle", "surfaces", "transforms"}
BUCKETS = {192, 384, 768, 1536}


def answer_nothing(params, source, target) -> Registration:
    """A stand-in for `register_clouds`: the right shapes, at no cost."""
    n, m = len(source.points), len(target.points)
    masks = prefix_mask(n, source.count), prefix_mask(m, target.count)
    branch = Branch(jnp.zeros((n, m)), jnp.zeros((n, 3)), jnp.zeros(n))
    return Registration(
        rotation=jnp.eye(3),
        translation=jnp.zeros(3),
        src_overlap=masks[0] * 1.0,
        tgt_overlap=masks[1] * 1.0,
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
    reached, waiting = set(), [package / "alignment" / "search.py"]
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

    monkeypatch.setattr(search, "register_clouds", register_clouds)
    monkeypatch.setattr(search.em_icp, "refine", refine)
    monkeypatch.setattr(search, "_PROGRAMS", {})
    # Not through files: the stand-in must not be kept as the network's program.
    monkeypatch.setattr(search, "load_or_trace", lambda function, *rest: jax.jit(function))
    for n, m in np.random.default_rng(0).integers(16, max(BUCKETS) + 1, (50, 2)):
        source, target = random_cloud(n, n), random_cloud(m, m)
        proposal = search.predict_pose(tiny_params(), source, target)
        assert proposal.mass.shape == (n, m)
        assert proposal.source_kept.all() and proposal.target_overlap.all()
        search.refine(proposal.transform, source, target)
    for traces in (networks, refinements):
        assert len(traces) == len(set(traces)) <= len(BUCKETS)
        assert {size for pair in traces for size in pair} <= BUCKETS


def test_two_functions_of_equal_arguments_are_two_programs(monkeypatch):
    monkeypatch.setattr(search, "_PROGRAMS", {})
    one, two = (search._run(f"add {k}", lambda x, k=k: x + k, jnp.ones(3)) for k in (1, 2))
    assert (two - one == 1).all()
