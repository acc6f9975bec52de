"""Sweeps over the protocol: what is drawn, scored, written and shown."""

import csv

import pytest

from configs import cad, threedmatch
from dbdnet_jax.classical.open3d import identity
from dbdnet_jax.data import test_pairs
from dbdnet_jax.evaluation import sweep
from dbdnet_jax.evaluation.methods import Method, Weights, from_points
from dbdnet_jax.evaluation.sweep import SWEEPS, render_sweep, save_sweep
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.config import read_config

NO_NETWORK = [Weights("", Params({}, read_config(cad.get_config()).model))]


@pytest.fixture
def config(monkeypatch):
    """The CAD config, with one cheap method on few pairs."""
    monkeypatch.setattr(sweep, "make_methods", lambda *_: [Method("still", from_points(identity))])
    monkeypatch.setattr(test_pairs, "CAD_PAIRS", 4)
    return read_config(cad.get_config())


def test_a_method_is_scored_at_every_value_of_what_is_varied(config, tmp_path, monkeypatch):
    values = (15, 30, 45)  # each is a protocol that is compiled
    monkeypatch.setitem(SWEEPS, "rotation", SWEEPS["rotation"]._replace(values=values))
    points = list(
        sweep.sweep("rotation", config.data, config.protocol, NO_NETWORK, tmp_path, seed=0, count=3)
    )
    assert tuple(point.value for point in points) == values
    errors = [point.row.summary.error_rotation_deg for point in points]
    # A method that does not move errs by the rotation itself.
    assert errors[0] < 15 * 3**0.5 and errors == sorted(errors)
    assert {point.row.summary.pairs for point in points} == {3}
    path = save_sweep("rotation", points, tmp_path / "new", "python evaluate.py")
    lines = list(csv.DictReader(path.read_text().splitlines()))
    assert tuple(float(line["value"]) for line in lines) == values
    assert {(line["pairs"], line["command"]) for line in lines} == {("3", "python evaluate.py")}
    assert float(lines[0]["error_r"]) == pytest.approx(errors[0], rel=1e-5)
    shown = render_sweep("rotation", points, "python evaluate.py")
    assert "largest Euler angle, degrees" in shown and f"{errors[0]:.1f} /" in shown


@pytest.mark.parametrize("name", SWEEPS)
def test_every_value_is_a_protocol_of_its_own(name):
    protocol = read_config(cad.get_config()).protocol
    changed = [SWEEPS[name].change(protocol, value) for value in SWEEPS[name].values]
    assert len(set(changed)) == len(changed)
    assert protocol in changed  # the paper's own


def test_scans_cannot_be_varied(tmp_path):
    with pytest.raises(ValueError, match="a sweep needs shapes.*threedmatch.*configs/cad.py"):
        config = read_config(threedmatch.get_config())
        next(
            sweep.sweep("crop", config.data, config.protocol, NO_NETWORK, tmp_path, seed=0, count=1)
        )
