"""The authors' weights of DCP give the outputs that their code recorded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dcp.network import DCPConfig, predict, shapes
from dbdnet_jax.networks.dcp.released import entries, from_released
from dbdnet_jax.networks.torch_state import arrays_from_state
from dbdnet_jax.types import Cloud
from tests.peers import EVALUATION, WEIGHTS, assert_near, bundle, clouds

needs_weights = pytest.mark.skipif(
    not WEIGHTS.exists(), reason="needs ../shared/peers/weights, the authors' files"
)


@needs_weights
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("case", ["trained_v1", "trained_v1_partial"])
def test_recorded_outputs(case):
    params = from_released(WEIGHTS / "dcp_v1.t7")
    params = jax.tree.map(lambda x: x.astype(jnp.float64), params)
    arrays = bundle("dcp")
    if f"{case}/source" not in arrays:
        pytest.skip("needs ../shared/peers: the fixture in the repository leaves these clouds out")
    pair = clouds(arrays[f"{case}/source"]), clouds(arrays[f"{case}/target"])
    for b in range(len(arrays[f"{case}/source"])):
        one = [Cloud(cloud.points[b], cloud.count[b]) for cloud in pair]
        pose = jax.jit(predict)(params, *one).motion
        assert_near(pose.rotation, arrays[f"{case}/rotation_ab"][b], 100 * EVALUATION)
        assert_near(pose.translation, arrays[f"{case}/translation_ab"][b], 100 * EVALUATION)


@pytest.mark.parametrize("pointer", ["identity", "transformer"])
def test_every_parameter_has_an_entry(pointer):
    config = DCPConfig(pointer=pointer)
    state = {entry.name: np.zeros(entry.shape) for entry in entries(config).values()}
    found = arrays_from_state(state, entries(config), "nothing")
    assert {name: x.shape for name, x in found.items()} == shapes(config)
    assert from_released(state).config == config


def test_a_missing_tensor_is_named():
    state = {entry.name: np.zeros(entry.shape) for entry in entries(DCPConfig()).values()}
    del state["emb_nn.conv1.weight"]
    with pytest.raises(CheckpointError, match="1 missing: emb_nn.conv1.weight"):
        from_released(state)
