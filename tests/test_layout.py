"""The listed parameters are those of the networks."""

import jax
import numpy as np
import pytest
from flax.traverse_util import flatten_dict

from dbdnet_jax.layout import flatten, parameter_shapes, require_shapes, unflatten
from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.dbdnet import init_params
from dbdnet_jax.safe_pickle import CheckpointError

# Every number differs from every other, so that none stands in for another.
CONFIG = ModelConfig(
    overlap_channels=8,
    overlap_blocks=1,
    registration_channels=12,
    shared_blocks=3,
    rotation_blocks=2,
    translation_blocks=4,
)


def test_the_list_is_what_initialising_makes():
    params = jax.eval_shape(lambda key: init_params(key, CONFIG), jax.random.key(0))
    tree = flatten_dict({"overlap": params.overlap, "registration": params.registration}, sep="/")
    assert {name: leaf.shape for name, leaf in tree.items()} == parameter_shapes(CONFIG)


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
