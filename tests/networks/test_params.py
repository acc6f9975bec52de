"""The listed parameters are those of the networks, and how they start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.overlap import OverlapNetwork
from dbdnet_jax.networks.dbdnet.registration import RegistrationNetwork
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import flatten, require_shapes, unflatten
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.ops.pyramid import build_pyramids
from dbdnet_jax.types import Cloud

# Every number differs from every other, so that none stands in for another.
CONFIG = ModelConfig(
    overlap_channels=8,
    overlap_blocks=1,
    overlap_matching=True,
    registration_channels=12,
    shared_blocks=3,
    rotation_blocks=2,
    translation_blocks=4,
    head_width=128,
    parameter_width=256,
)


def test_the_list_is_what_initialising_makes():
    clouds = Cloud(jnp.zeros((2, 16, 3)), jnp.full((2,), 16))
    pyramids = build_pyramids(clouds, CONFIG.neighbours)
    networks = {
        "overlap": (OverlapNetwork(CONFIG), clouds, pyramids),
        "registration": (RegistrationNetwork(CONFIG), clouds),
    }
    tree = {
        name: jax.eval_shape(network.init, jax.random.key(0), *inputs)["params"]
        for name, (network, *inputs) in networks.items()
    }
    made = {name: leaf.shape for name, leaf in flatten_dict(tree, sep="/").items()}
    assert made == parameter_shapes(CONFIG)


def test_fresh_parameters_are_distributed_as_torch_does():
    arrays = flatten(init_params(jax.random.key(0), CONFIG))
    assert arrays.keys() == parameter_shapes(CONFIG).keys()
    block = "overlap/attention_0/self_attention"
    glorot = (6 / (32 + 96)) ** 0.5
    for name, bound in (
        ("overlap/decoder_0/conv/kernel", 73**-0.5),
        ("overlap/decoder_0/conv/bias", 73**-0.5),
        (f"{block}/in_proj/kernel", glorot),
        (f"{block}/out_proj/kernel", 32**-0.5),
    ):
        largest = np.abs(arrays[name]).max()
        assert 0.95 * bound < largest <= bound, name
        assert np.std(arrays[name]) == pytest.approx(bound / 3**0.5, rel=0.1), name
    for name in (f"{block}/in_proj/bias", f"{block}/out_proj/bias", "overlap/decoder_0/norm/bias"):
        assert not arrays[name].any(), name
    assert (arrays["overlap/decoder_0/norm/scale"] == 1).all()


def test_matching_starts_soft():
    arrays = flatten(init_params(jax.random.key(0), CONFIG))
    width = 4 * CONFIG.overlap_channels
    beta, alpha = (arrays[f"overlap/matching/{name}"] for name in ("beta", "alpha"))
    # Normalised features lie about sqrt(2 width) apart: an affinity of -2 beside a slack of 0.
    assert -np.log1p(np.exp(beta)) * (2 * width - alpha) == pytest.approx(-2.0, rel=1e-5)
    assert alpha == 1.5 * width


def test_flatten_and_unflatten_undo_each_other():
    shapes = parameter_shapes(CONFIG, ("registration",))
    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    params = unflatten(arrays, CONFIG)
    assert params.overlap is None and params.config == CONFIG
    back = flatten(params)
    assert back.keys() == arrays.keys()
    assert all((back[name] == arrays[name]).all() for name in back)


def test_problems_are_listed_and_pages_are_not_filled():
    expected = {"a": (1,), "b": (2, 3)}
    require_shapes(dict(expected), expected, "x", "")
    with pytest.raises(CheckpointError) as error:
        found = {"b": (3, 2), "c": (), **{f"extra{i}": () for i in range(60)}}
        require_shapes(found, expected, "x.npz", "Fix it.")
    text = str(error.value)
    assert text.startswith("x.npz must hold exactly the network's parameters; 1 missing: a; ")
    assert "61 unknown: c, extra0," in text and "extra48, ...; " in text and "extra49" not in text
    assert text.endswith("1 misshapen: b is (3, 2) instead of (2, 3). Fix it.")
