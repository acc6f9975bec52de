"""Networks that see the local geometry: weights that grow, turns that share it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.growing import with_local_geometry
from dbdnet_jax.networks.dbdnet.register import register_clouds
from dbdnet_jax.networks.params import flatten
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.types import Cloud
from tests.conftest import EXACT, Tolerance, assert_close, random_cloud
from tests.networks.dbdnet.small import SMALL, padded, small_params, whole

WITH = dataclasses.replace(
    SMALL, local_geometry=2, overlap_matching=True, overlap_passes=2, overlap_points=24
)
SOURCE, TARGET = random_cloud(1, 40), random_cloud(2, 44)
answer = jax.jit(register_clouds)
# Around lonely points the cube roots are of rounding errors: 1e-16 becomes 1e-5, and the network
# stretches that.
ROOTS = Tolerance(rtol=1e-3, atol=1e-3)


def test_weights_grow_without_a_change_of_the_answer():
    params = small_params(dtype=np.float32)
    grown = with_local_geometry(params, 3)
    shapes = {name: array.shape for name, array in flatten(grown).items()}
    assert shapes == parameter_shapes(grown.config)
    clouds = [whole(np.float32(points)) for points in (SOURCE, TARGET)]
    for old, new in zip(answer(params, *clouds), answer(grown, *clouds), strict=True):
        jax.tree.map(lambda a, b: assert_close(b, a, EXACT), old, new)
    again = with_local_geometry(grown, 4)
    twice = with_local_geometry(params, 4)
    jax.tree.map(lambda a, b: assert_close(b, a, EXACT), again.overlap, twice.overlap)


def test_weights_do_not_shrink():
    with pytest.raises(ValueError, match="added, not taken away"):
        with_local_geometry(small_params(config=WITH, dtype=np.float32), 1)


def test_the_network_sees_it(x64):
    params = small_params(config=WITH)
    kernel = params.overlap["encoder"]["stage1_conv1"]["conv_0"]["kernel"]
    blind = jax.tree.map(lambda leaf: leaf, params)
    blind.overlap["encoder"]["stage1_conv1"]["conv_0"]["kernel"] = kernel.at[3].set(0.0)
    seen = [answer(p, whole(SOURCE), whole(TARGET)).src_overlap for p in (params, blind)]
    assert np.abs(seen[0] - seen[1]).max() > 1e-4


def test_padding_and_order_of_the_pair_change_nothing(x64):
    params = small_params(config=WITH)
    plain = answer(params, whole(SOURCE), whole(TARGET))
    filled = answer(params, padded(SOURCE, 70, np.nan), padded(TARGET, 70, 9.0))
    assert_close(filled.rotation, plain.rotation, ROOTS)
    assert_close(filled.src_overlap[:40], plain.src_overlap, ROOTS)


def test_a_translation_moves_the_answer_only(x64):
    params = small_params(config=WITH)
    shift = jnp.asarray([[2.0, -1.0, 0.5]])
    plain = answer(params, whole(SOURCE), whole(TARGET))
    moved = answer(params, Cloud(SOURCE + shift, jnp.asarray(len(SOURCE))), whole(TARGET))
    assert_close(moved.rotation, plain.rotation, ROOTS)
    assert_close(moved.tgt_overlap, plain.tgt_overlap, ROOTS)


@pytest.mark.parametrize("radii", [6, -1])
def test_what_cannot_be_seen_is_refused(radii):
    with pytest.raises(ValueError, match=f"local_geometry must be from 0 to 5; got {radii}"):
        ModelConfig(local_geometry=radii)


@pytest.mark.parametrize("name", ["local_geometry", "overlap_points", "registration_points"])
def test_the_released_network_sees_all_points_and_nothing_else(name):
    with pytest.raises(ValueError, match=f"{name} must be 0 where released=True.*got 2. Use 0"):
        ModelConfig(released=True, **{name: 2})
