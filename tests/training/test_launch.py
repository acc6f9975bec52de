"""How the scripts start: on the cores that they may use, with the processes they are told of."""

from types import SimpleNamespace

import jax
import pytest

from dbdnet_jax.training import launch


@pytest.fixture
def started(monkeypatch):
    """Starts with these flags; returns the CPU devices asked for and the processes joined."""

    def start(devices, pairs, **given):
        found = {"joined": None}
        for name in ("distributed", "coordinator", "processes", "process_id"):
            flag = SimpleNamespace(value=given.get(name))
            monkeypatch.setattr(launch, name.upper(), flag)
        monkeypatch.setattr(jax.config, "update", lambda name, value: found.update({name: value}))
        monkeypatch.setattr(launch, "available_cores", lambda: [0, 2, 5])  # as under taskset
        monkeypatch.setattr(launch, "join_processes", lambda *way: found.update(joined=way))
        for name in ("keep_compiled_programs", "require_device"):
            monkeypatch.setattr(launch, name, lambda: None)
        launch.start(devices, pairs)
        return found["jax_num_cpu_devices"], found["joined"]

    return start


def test_a_cpu_has_a_device_for_each_core_that_the_process_may_use(started):
    assert started(0, 8) == (3, None)
    assert started(0, 2) == (2, None)
    assert started(6, 8) == (6, None)


def test_processes_join_by_a_coordinator_or_a_scheduler(started):
    way = {"coordinator": "host:1", "processes": 2, "process_id": 1}
    assert started(6, 8, **way) == (3, ("host:1", 2, 1))
    assert started(0, 8, distributed=True) == (3, (None, None, None))


@pytest.mark.parametrize("alone", [{"processes": 2, "process_id": 1}, {"process_id": 0}])
def test_a_process_that_could_join_nobody_is_refused(started, alone):
    with pytest.raises(
        ValueError, match=f"or --distributed.*process_id={alone['process_id']}. Add"
    ):
        started(0, 8, **alone)
