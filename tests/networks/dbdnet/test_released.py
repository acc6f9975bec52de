"""The authors' checkpoints: their names and layouts, found and refused."""

import json
import time
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.released import from_released, to_released
from dbdnet_jax.networks.params import flatten, unflatten
from dbdnet_jax.networks.table import parameter_shapes
from tests.torch_files import save_stream, save_zip, tensor

# Written once and checked against the names and shapes of a model built by the released code.
PINNED = json.loads((Path(__file__).parents[2] / "fixtures" / "released_names.json").read_text())
SHAPES = Path(__file__).parents[4] / "shared" / "golden" / "released_state_dict_shapes.json"
UNUSED = ("self_attention", "self_layer_norm", "cross_attention", "cross_layer_norm")
BLOCK = "overlap_predictor.attention.0."


def numbers(shape, seed):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.fixture
def state() -> dict[str, np.ndarray]:
    """A state dict of the pinned configuration, the entries that are never used included."""
    state = {
        name: numbers(shape, seed) for seed, (name, shape, *_) in enumerate(PINNED["parameters"])
    }
    for name in list(state):
        if name.startswith(BLOCK):
            state[f"overlap_predictor.{name.removeprefix(BLOCK)}"] = state[name] + 1
    return state


def is_unused(name: str) -> bool:
    return name.removeprefix("overlap_predictor.").startswith(UNUSED)


def overlap_only(state):
    prefix = "overlap_predictor."
    return {n.removeprefix(prefix): x for n, x in state.items() if n.startswith(prefix)}


def test_every_pinned_entry_lands_at_its_place(state):
    params = from_released(state, k=8)
    assert params.config == ModelConfig(**PINNED["config"], neighbours=8, released=True)
    ours = flatten(params)
    assert len(ours) == len(PINNED["parameters"])
    for theirs, _, name, shape in PINNED["parameters"]:
        expected = state[theirs]
        if name.endswith("/kernel"):
            expected = expected.reshape(expected.shape[:2]).T
        assert ours[name].dtype == np.float32 and ours[name].shape == tuple(shape)
        assert np.array_equal(ours[name], expected), name


def test_queries_keys_and_values_keep_their_order(state):
    name = "RegNet.attention.0.cross_attention.in_proj_weight"
    width = state[name].shape[1]
    state[name] = np.repeat(np.array([1.0, 2.0, 3.0], np.float32), width)[:, None] * np.ones(width)
    kernel = from_released(state).registration["attention_0"]["cross_attention"]["in_proj"][
        "kernel"
    ]
    q, k, v = np.split(np.asarray(kernel), 3, axis=1)
    assert np.all(q == 1) and np.all(k == 2) and np.all(v == 3)


def test_the_round_trip_is_exact(state):
    back = to_released(from_released(state))
    assert back.keys() == state.keys()
    for name, array in back.items():
        assert array.dtype == np.float32 and array.shape == state[name].shape
        assert array.flags.c_contiguous and array.flags.writeable
        if not is_unused(name):
            assert np.array_equal(array, state[name]), name


def test_what_is_never_used_is_written_neutral_and_read_as_anything(state):
    back = to_released(from_released(state))
    unused = {name: array for name, array in back.items() if is_unused(name)}
    assert len(unused) == 12
    for name, array in unused.items():
        assert np.all(array == (1 if name.endswith("norm.weight") else 0)), name
        state[name] = "anything"
    from_released(state)
    from_released({name: x for name, x in state.items() if not is_unused(name)})


@pytest.mark.skipif(not SHAPES.exists(), reason="the released shapes lie beside the repository")
def test_the_full_size_names_and_shapes():
    shapes = {n: tuple(shape) for n, shape in json.loads(SHAPES.read_text()).items()}
    state = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    params = from_released({f"module.{name}": array for name, array in state.items()})
    assert params.config == ModelConfig(released=True)
    assert {name: array.shape for name, array in to_released(params).items()} == shapes


@pytest.mark.parametrize("save", [save_zip, save_stream])
@pytest.mark.parametrize("byteorder", ["little", "big"])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_files_of_both_formats(tmp_path, state, save, byteorder, prefix):
    path = tmp_path / "x.pth"
    entries = OrderedDict((prefix + name, tensor(array)) for name, array in state.items())
    save(path, entries, byteorder)
    got, expected = flatten(from_released(path)), flatten(from_released(state))
    assert all(np.array_equal(got[name], expected[name]) for name in expected)


@pytest.mark.parametrize("keys", [["state_dict"], ["model_state_dict"], ["checkpoint", "model"]])
def test_a_nested_state_dict_is_found(state, keys):
    saved = state
    for key in reversed(keys):
        saved = {"epoch": 3, key: saved}
    if keys[0] == "checkpoint":  # not a usual key
        with pytest.raises(CheckpointError, match="must hold .*stage1_conv1"):
            from_released(saved)
    else:
        assert from_released(saved).config.overlap_channels == 8


def test_an_overlap_network_alone(state):
    alone = overlap_only(state)
    params = from_released(alone, k=8)
    assert params.registration is None
    full = from_released(state, k=8)
    ours = flatten(params)
    assert ours.keys() == parameter_shapes(params.config, ("overlap",)).keys()
    assert all(np.array_equal(array, flatten(full)[name]) for name, array in ours.items())
    back = to_released(params)
    assert back.keys() == alone.keys()
    assert all(np.array_equal(back[n], alone[n]) for n in back if not is_unused(n))


def test_numbers_of_blocks_are_read_off(state):
    config = ModelConfig(
        overlap_channels=4,
        overlap_blocks=2,
        registration_channels=8,
        shared_blocks=1,
        rotation_blocks=3,
        translation_blocks=2,
        neighbours=5,
        released=True,
    )
    arrays = {n: numbers(s, i) for i, (n, s) in enumerate(parameter_shapes(config).items())}
    back = from_released(to_released(unflatten(arrays, config)), k=5)
    assert back.config == config
    assert all(np.array_equal(x, arrays[name]) for name, x in flatten(back).items())


def test_entries_that_do_not_fit_are_listed(state):
    conv = "feature_extractor.fusion_1.conv."
    del state["RegNet.attention_t.0.self_layer_norm.bias"]
    state[f"{conv}weight"] = state[f"{conv}weight"][..., 0]
    state["RegNet.surplus"] = np.zeros(3)
    with pytest.raises(CheckpointError) as error:
        from_released(state)
    text = str(error.value)
    assert "1 missing: RegNet.attention_t.0.self_layer_norm.bias;" in text
    assert "1 unknown: RegNet.surplus;" in text
    assert f"1 misshapen: {conv}weight is (8, 40) instead of (8, 40, 1)." in text


def test_a_gap_in_the_blocks_is_named(state):
    for name in list(state):
        if name.startswith("RegNet.attention_R.0."):
            state[name.replace("R.0", "R.1")] = state.pop(name)
    with pytest.raises(CheckpointError, match=r"12 missing: RegNet.attention_R.0.*12 unknown"):
        from_released(state)


def test_other_contents_are_refused(tmp_path, state):
    for value in ([1, 2], {"model": [1]}, {}, {"encoder.stage1_conv1.conv.0.conv.weight": 3.0}):
        with pytest.raises(CheckpointError, match="The state dict must hold"):
            from_released(value) if isinstance(value, dict) else from_released({"net": value})
    save_zip(tmp_path / "x.pth", [1, 2])
    with pytest.raises(CheckpointError, match=r"x\.pth must hold a state dict; got a list"):
        from_released(tmp_path / "x.pth")
    endless = {}
    endless["model"] = endless
    with pytest.raises(CheckpointError, match="must hold a state dict"):
        from_released(endless)
    state["RegNet.weight_net.encoder.0.bias"] = np.zeros(64, np.int64)
    with pytest.raises(CheckpointError, match="encoder.0.bias is int64"):
        from_released(state)


def test_what_their_code_cannot_run_is_not_written(state):
    params = from_released(state)
    with pytest.raises(ValueError, match="neighbour_space is 'feature' .* got 'coordinates'"):
        to_released(params.replace(config=ModelConfig(neighbour_space="coordinates")))
    with pytest.raises(ValueError, match="overlap=None"):
        to_released(params.replace(networks={"registration": params.registration}))


def test_numbers_that_are_not_finite_are_refused(state):
    name = next(iter(state))
    state[name] = np.full_like(state[name], np.nan)
    with pytest.raises(CheckpointError, match="must hold finite numbers; .* 1 of"):
        from_released(state)


@pytest.mark.parametrize("count", [1000, 100_000])
def test_any_number_of_blocks_is_refused_at_once(state, count):
    stem = "overlap_predictor.attention."
    state |= {f"{stem}{i}.self_attention.in_proj_weight": np.ones(1) for i in range(count)}
    start = time.process_time()
    with pytest.raises(CheckpointError, match=r"overlap_blocks must be from|at most 20000 entries"):
        from_released(state)
    assert time.process_time() - start < 2


@pytest.mark.parametrize("k", [0, -1, True, 10**9])
def test_a_number_of_neighbours_that_is_none_is_refused(state, k):
    with pytest.raises(CheckpointError, match="neighbours must be"):
        from_released(state, k=k)
