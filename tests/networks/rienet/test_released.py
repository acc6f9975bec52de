"""The authors' weights of RIENet give the outputs that their code recorded."""

import jax
import jax.numpy as jnp
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.batch_norm import fold
from dbdnet_jax.networks.rienet.network import RIENet, RIENetConfig, pose_of, shapes
from dbdnet_jax.networks.rienet.released import entries, from_released
from dbdnet_jax.networks.torch_state import arrays_from_state
from tests.peers import EVALUATION, WEIGHTS, assert_near, bundle, clouds

FILES = {
    "modelnet": {},
    "modelnet-unseen": {},
    "7scenes": {"k1": 8, "k2": 8, "margin": 0.5},
    "icl_nuim": {"k1": 32, "k2": 10, "margin": 0.5},
}
needs_weights = pytest.mark.skipif(
    not WEIGHTS.exists(), reason="needs ../shared/peers/weights, the authors' files"
)


@needs_weights
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", FILES)
def test_recorded_outputs(name):
    params = from_released(WEIGHTS / f"rienet_{name}.t7", **FILES[name])
    params = jax.tree.map(lambda x: x.astype(jnp.float64), params)
    arrays = bundle("rienet")
    pair = clouds(arrays["trained/source"]), clouds(arrays["trained/target"])

    @jax.jit
    def run(params):
        variables = {"params": fold(params.networks["rienet"])}
        return RIENet(params.config).apply(variables, *pair)[0]

    turns = run(params)
    prefix = f"trained_{name}"
    first, whole = turns[0].increment, pose_of(turns)
    for actual, key in (
        (whole.rotation, "rotation"),
        (whole.translation, "translation"),
        (first.rotation, "rotation_iteration0"),
        (first.translation, "translation_iteration0"),
        (turns[-1].confidence, "weight_last"),
    ):
        assert_near(actual, arrays[f"{prefix}/{key}"], 100 * EVALUATION)


def test_every_parameter_has_an_entry():
    config = RIENetConfig()
    found = arrays_from_state(
        {entry.name: jnp.zeros(entry.shape) for entry in entries(config).values()},
        entries(config),
        "nothing",
    )
    assert {name: x.shape for name, x in found.items()} == shapes(config)


def test_another_networks_tensors_are_refused():
    with pytest.raises(CheckpointError, match="must hold forwards.weight_function.model1.0.weight"):
        from_released({"emb_nn.conv1.weight": jnp.zeros((64, 6, 1, 1))})
