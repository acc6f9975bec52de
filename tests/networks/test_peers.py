"""What holds for every learned method: padding and company change nothing, files keep all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.batch_norm import fold_params
from dbdnet_jax.networks.inenet.network import as_channels
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.table import learned
from dbdnet_jax.networks.weights import load_params, save_params
from dbdnet_jax.types import Cloud
from tests.conftest import Tolerance, assert_close, random_cloud
from tests.networks.small_peers import CONFIGS, SIZE

COUNTS = 30, 27
# A whole network in float32, its sums in another order.
NETWORK = Tolerance(rtol=1e-3, atol=1e-4)


def pair(rows: int, garbage: float) -> tuple[Cloud, Cloud]:
    """Two clouds with ``garbage`` in the rows after their points."""
    found = []
    for seed, count in enumerate(COUNTS):
        points = np.full((rows, 3), garbage, np.float32)
        points[:count] = random_cloud(seed, count)
        found.append(Cloud(jnp.asarray(points), jnp.asarray(count)))
    return found[0], found[1]


def of_points(answer):
    """The answer without the rows of the padding."""
    overlaps = (answer.source_overlap, answer.target_overlap)
    kept = [x[..., :n] for x, n in zip(overlaps, COUNTS, strict=True) if x is not None]
    return jax.tree.leaves((answer.motion, kept))


@pytest.mark.parametrize("name", CONFIGS)
def test_padding_and_company_change_no_answer(name):
    config = CONFIGS[name]
    params = init_params(jax.random.key(0), config)
    predict = learned(config).predict
    some, more = (
        jax.jit(predict)(params, *pair(rows, garbage))
        for rows, garbage in ((32, 1e3), (SIZE, np.nan))
    )
    for one, other in zip(of_points(more), of_points(some), strict=True):
        assert_close(one, other, NETWORK)
    for overlap, count in zip(more[1:], COUNTS, strict=True):
        assert overlap is None or not overlap[count:].any()
    stacked = jax.tree.map(lambda *x: jnp.stack(x), pair(SIZE, 0.0), pair(SIZE, 0.0)[::-1])
    many = jax.vmap(predict, in_axes=(None, 0, 0))(fold_params(params), *stacked)
    first = jax.tree.map(lambda x: x[0], many)
    for one, other in zip(of_points(first), of_points(some), strict=True):
        assert_close(one, other, NETWORK)


@pytest.mark.parametrize("name", CONFIGS)
def test_weights_survive_a_file(tmp_path, name):
    params = init_params(jax.random.key(0), CONFIGS[name])
    save_params(tmp_path / "x.npz", params)
    loaded = load_params(tmp_path / "x.npz")
    assert loaded.config == params.config and hash(loaded.config) == hash(params.config)
    jax.tree.map(np.testing.assert_array_equal, loaded.networks, params.networks)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("dcp", {"pointer": "none"}, "pointer must be one of"),
        ("dcp", {"heads": 3}, "a multiple of heads"),
        ("rienet", {"k2": 1}, "at least 2"),
        ("omnet", {"kept": 4}, "kept must be one of the encoder's 3 layers"),
        ("finet", {"exchanges": (2, 2)}, "exchanges must be increasing"),
        ("inenet", {"encoder": (8, 8)}, "encoder must have four widths"),
    ],
)
def test_wrong_sizes_are_refused(name, changes, message):
    fields = vars(CONFIGS[name]) | changes
    with pytest.raises(ValueError, match=message):
        type(CONFIGS[name])(**fields)


def test_more_points_than_inenet_has_channels_are_refused():
    with pytest.raises(ValueError, match=f"at most {SIZE} points, its number of channels; got 41"):
        as_channels(pair(SIZE + 1, 0.0)[0], CONFIGS["inenet"])


def test_the_order_of_the_target_is_inenets_only_where_it_is_the_authors():
    config = CONFIGS["inenet"]
    cloud = pair(SIZE, 0.0)[0]
    order = jnp.concatenate([jnp.arange(COUNTS[0])[::-1], jnp.arange(COUNTS[0], SIZE)])
    turned = cloud._replace(points=cloud.points[order])
    np.testing.assert_array_equal(
        as_channels(cloud, config).points, as_channels(turned, config).points
    )
    released = type(config)(**{**vars(config), "released": True})
    np.testing.assert_array_equal(as_channels(turned, released).points, turned.points)
