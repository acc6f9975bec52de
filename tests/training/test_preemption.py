"""train.py itself, stopped by signals: nothing is lost, and the same command goes on."""

import os
import pty
import signal
import subprocess
import time
from pathlib import Path

import pytest

from benchmarks.interruptions import STAND_IN, differences, rows
from dbdnet_jax.training.preemption import Interrupted, interrupt_on_signals, stop_requests

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.mark.slow
def test_kills_at_random_moments_change_nothing(tmp_path):
    assert differences(STAND_IN, tmp_path, kills=2, seed=1) == []


@pytest.mark.slow
def test_a_closed_terminal_saves_and_a_second_training_is_refused(tmp_path):
    command = [*STAND_IN, f"--run_dir={tmp_path / 'run'}", "--config.overlap.epochs=200"]
    command += [f"--config.train.{name}_every=2000" for name in ("validate", "checkpoint")]
    terminal, theirs = pty.openpty()
    child = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    deadline = time.monotonic() + 300
    while rows(tmp_path / "run") < 2:
        assert child.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    second = subprocess.run(command, capture_output=True, text=True)
    os.close(terminal)  # writing to it is an error from now on
    child.send_signal(signal.SIGHUP)
    assert child.wait(timeout=120) == 0
    (saved,) = (tmp_path / "run" / "overlap" / "checkpoints").glob("[0-9]*")
    assert int(saved.name) == rows(tmp_path / "run")
    assert second.returncode == 1 and f"there is process {child.pid} on " in second.stderr
    assert "Traceback" not in second.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_leave_a_note_or_interrupt(number):
    with interrupt_on_signals():
        with stop_requests() as stop:
            assert not stop.name
            signal.raise_signal(number)
            assert stop.name == number.name
        with pytest.raises(Interrupted):
            signal.raise_signal(number)


def test_a_second_ctrl_c_does_not_wait():
    with stop_requests():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGINT)


def test_what_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_requests() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.name
    finally:
        signal.signal(signal.SIGHUP, before)
