"""Which weights a stage may start from, and what is said of those that were trained otherwise."""

import dataclasses

import jax
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.masknet.network import MaskNetConfig
from dbdnet_jax.networks.weights import save_params
from dbdnet_jax.training.start import describe_start, load_start
from dbdnet_jax.training.task import RunConfig
from tests.training.test_dbdnet import CONFIG


@pytest.fixture
def starting(tmp_path):
    """The configuration with changes of its model, from weights of the model as it was."""
    path = tmp_path / "weights.npz"
    save_params(path, init_params(jax.random.key(0), CONFIG.model))

    def config(**changes) -> RunConfig:
        return dataclasses.replace(
            CONFIG,
            model=dataclasses.replace(CONFIG.model, **changes),
            train=dataclasses.replace(CONFIG.train, start=str(path)),
        )

    return config


def test_weights_may_go_on_with_other_settings_which_are_named(starting):
    config = starting(min_points=13, overlap_passes=3)
    assert load_start(config).config == config.model
    line = describe_start(config)
    assert line.endswith("were trained with overlap_passes = 1 (now 3), min_points = 12 (now 13).")
    assert describe_start(starting()).endswith("were trained with the same config.model.")


def test_weights_do_not_go_on_with_channels_divided_otherwise(starting):
    with pytest.raises(CheckpointError, match=r"heads must be that .*got 4 for .* with 2\. Use 2"):
        load_start(starting(heads=4))


def test_weights_of_another_method_are_no_start(starting, tmp_path):
    config = starting()
    other = MaskNetConfig(encoder=(4, 8), head=(4,))
    save_params(tmp_path / "weights.npz", init_params(jax.random.key(0), other))
    for read in (load_start, describe_start):
        with pytest.raises(CheckpointError, match="of the method dbdnet; .* holds some of masknet"):
            read(config)
