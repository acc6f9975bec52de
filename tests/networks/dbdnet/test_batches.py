"""The whole network under `jax.vmap`: the same alone, in a batch and in any other batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.types import Registration
from tests.conftest import EXACT, assert_close, random_cloud
from tests.networks.dbdnet.small import NETWORK, small_params

N = 40
alone = jax.jit(register)
batch = jax.jit(jax.vmap(register, in_axes=(None, 0, 0, 0, 0)))


def stacked(*seeds: int):
    """Pairs of clouds and masks; each pair of another size."""
    clouds = [np.stack([random_cloud(2 * seed + c, N) for seed in seeds]) for c in (0, 1)]
    masks = [np.stack([np.arange(N) < N - (seed + 5 * c) % 12 for seed in seeds]) for c in (0, 1)]
    return tuple(jnp.asarray(x) for x in (*clouds, *masks))


def assert_same(found: Registration, expected: Registration):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_close(a, b, NETWORK if a.dtype == np.float64 else EXACT)


@pytest.mark.parametrize("seeds", [(3, 4, 5), (9, 4, 2), (4, 4, 4)])
def test_a_pair_is_registered_alike_in_every_batch(seeds, x64):
    params = small_params(5)
    expected = alone(params, *(x[0] for x in stacked(4)))
    assert expected.valid
    answers = batch(params, *stacked(*seeds))
    assert_same(jax.tree.map(lambda x: x[1], answers), expected)


def test_what_cannot_be_registered_spoils_no_other_pair(x64):
    params = small_params(5)
    src, tgt, src_mask, tgt_mask = stacked(3, 4, 5)
    expected = batch(params, src, tgt, src_mask, tgt_mask)
    src, tgt_mask = src.at[0].set(jnp.nan), tgt_mask.at[2].set(False)
    found = batch(params, src, tgt, src_mask, tgt_mask)
    assert found.valid.tolist() == [False, True, False]
    assert_same(*(jax.tree.map(lambda x: x[1], answer) for answer in (found, expected)))
