"""The encoder against the paper's section III-A in plain loops, and what padding must not do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.encoder import Encoder
from dbdnet_jax.ops.pyramid import build_pyramid
from tests import oracle
from tests.conftest import assert_close, random_cloud
from tests.networks.dbdnet.small import NETWORK, SMALL, padded, small_params, whole

N = 40
CHANNELS, K = SMALL.overlap_channels, SMALL.neighbours
GROUPS = (4, 4, 8, 8)


def farthest_first(points, count: int) -> np.ndarray:
    return points[oracle.farthest_order(points, count)]


def encode_eagerly(params, cloud, skip_rows=None, space: str = "feature"):
    pyramid = build_pyramid(cloud, K, skip_rows)
    return Encoder(CHANNELS, space).apply({"params": params}, cloud.points, pyramid)


encode = jax.jit(encode_eagerly, static_argnums=3)


def rectified(layer, x):
    return np.maximum(x @ layer["conv"]["kernel"] + layer["conv"]["bias"], 0.0)


def edge_conv(layer, x, groups):
    layers = [
        (
            *(layer[f"conv_{i}"][part] for part in ("kernel", "bias")),
            *(layer[f"norm_{i}"][part] for part in ("scale", "bias")),
        )
        for i in (0, 1)
    ]
    return oracle.edge_conv(x, K, layers, groups)


def encoder_oracle(params, points, skip_rows=None):
    """Four stages of an EdgeConv per level and an exchange of all levels; fusion; the necks.

    ``points`` are in farthest-point order. With ``skip_rows``, the finest level's feature goes
    down two levels or more by reading these rows, as in the released code.
    """
    sizes = [len(points) >> level for level in range(4)]

    def moved(name, x, fine_or_coarse, level):
        if fine_or_coarse > level:
            x = oracle.interpolate(
                x, points[: sizes[level]], points[: sizes[fine_or_coarse]], sizes[fine_or_coarse]
            )
        elif skip_rows is not None and fine_or_coarse == 0 and level > 1:
            x = x[skip_rows]
        return rectified(params[name], x[: sizes[level]])

    features, outputs = [points], [[], [], [], []]
    for stage in range(1, 5):
        convolved = [
            edge_conv(params[f"stage{stage}_conv{level + 1}"], x, GROUPS[level])
            for level, x in enumerate(features)
        ]
        features = []
        for level in range(min(stage + 1, 4)):
            total = convolved[level] if level < stage else 0.0
            for other, x in enumerate(convolved):
                way = "up" if other > level else "down"
                name = f"stage{stage}_{way}_{other + 1}_{level + 1}"
                if level == stage and other == level - 1:
                    layer, kept = params[name]["conv"], range(sizes[level])
                    total = total + oracle.transition_down(
                        points[: sizes[other]], x, kept, K, layer["kernel"], layer["bias"]
                    )
                elif other != level:
                    total = total + moved(name, x, other, level)
            features.append(total)
        for level, x in enumerate(convolved):
            outputs[level].append(x)
    fused = [
        rectified(params[f"fusion_{level + 1}"], np.concatenate([*outputs[level], x], axis=1))
        for level, x in enumerate(features)
    ]
    necks = [moved(f"neck_{level + 1}", fused[level], level, 0) for level in (1, 2, 3)]
    return np.concatenate([fused[0], *necks], axis=1)


@pytest.mark.parametrize("released", [False, True])
def test_the_encoder_is_the_papers_and_the_released_codes(released, x64):
    params = small_params().overlap["encoder"]
    points = random_cloud(0, N)
    order = oracle.farthest_order(points, N)
    skip_rows = np.argsort(order) if released else None
    found = encode(params, whole(points[order]), skip_rows)
    expected = encoder_oracle(jax.tree.map(np.asarray, params), points[order], skip_rows)
    assert found.dtype == np.float64
    assert_close(found, expected, NETWORK)


def test_the_two_ways_down_differ_only_where_the_rows_do(x64):
    params = small_params().overlap["encoder"]
    cloud = whole(farthest_first(random_cloud(1, N), N))
    plain = encode(params, cloud)
    assert_close(encode(params, cloud, jnp.arange(N)), plain, NETWORK)
    assert not np.allclose(encode(params, cloud, jnp.arange(N)[::-1]), plain)


@pytest.mark.parametrize("space", ["feature", "coordinates"])
def test_padding_does_not_change_a_feature(space, x64):
    count = 27
    params = small_params(1).overlap["encoder"]
    points = farthest_first(random_cloud(2, count), count)
    alone = encode(params, whole(points), None, space)
    for garbage in (0.0, 3.0):
        found = encode(params, padded(points, N, garbage), None, space)
        assert_close(found[:count], alone, NETWORK)


def test_neighbours_in_coordinates_are_another_network(x64):
    params = small_params().overlap["encoder"]
    cloud = whole(farthest_first(random_cloud(3, N), N))
    by_feature, by_place = (encode(params, cloud, None, x) for x in ("feature", "coordinates"))
    assert not np.allclose(by_feature, by_place)
    # With all points as neighbours there is nothing to choose.
    few = whole(farthest_first(random_cloud(4, K), K))
    found = [
        encode(params, padded(few.points, N, 0.0), None, x) for x in ("feature", "coordinates")
    ]
    assert_close(found[0][:K], found[1][:K], NETWORK)
