"""What MaskNet alone has: two roles, and layers that must be there."""

import jax
import numpy as np
import pytest

from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.masknet.network import MaskNetConfig, predict
from tests.conftest import FLOAT32, assert_close, random_cloud
from tests.networks.dbdnet.small import whole

CONFIG = MaskNetConfig(encoder=(8, 16), head=(16, 8))


def test_either_cloud_is_masked_given_the_other():
    params = init_params(jax.random.key(0), CONFIG)
    clouds = [whole(random_cloud(seed, n).astype(np.float32)) for seed, n in ((1, 12), (2, 9))]
    found, swapped = predict(params, *clouds), predict(params, *clouds[::-1])
    assert found.motion is None
    assert found.source_overlap.shape == (12,) and found.target_overlap.shape == (9,)
    assert_close(swapped.source_overlap, found.target_overlap, FLOAT32)
    assert_close(swapped.target_overlap, found.source_overlap, FLOAT32)
    other = predict(params, clouds[0], whole(random_cloud(3, 9).astype(np.float32)))
    assert np.abs(other.source_overlap - found.source_overlap).max() > 1e-4


@pytest.mark.parametrize("name", ["encoder", "head"])
def test_layers_of_nothing_are_refused(name):
    with pytest.raises(ValueError, match=rf"{name} must hold .* got \(8, 0\). Use \("):
        MaskNetConfig(**{name: (8, 0)})
