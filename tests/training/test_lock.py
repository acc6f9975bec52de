"""One training in a folder: a second one is told of the first, and a dead one holds nothing."""

import fcntl
import os
import signal
import subprocess
import sys

import pytest

from dbdnet_jax.training.lock import LOCK, sole_training

HOLD = "import sys; from pathlib import Path; from dbdnet_jax.training.lock import sole_training\n"
HOLD += "with sole_training(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"


def test_the_lock_names_its_holder_and_ends_with_it(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"held\n"
    with pytest.raises(BlockingIOError, match=f"there is process {child.pid} on .* --run_dir"):
        with sole_training(tmp_path):
            pass
    child.send_signal(signal.SIGKILL)
    child.communicate()
    with sole_training(tmp_path):
        assert (tmp_path / LOCK).read_text().startswith(f"process {os.getpid()} on ")


def test_a_file_system_without_locks_costs_a_warning(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "lockf", no_locks)
    with pytest.warns(RuntimeWarning, match="has no locks .No locks available"):
        with sole_training(tmp_path):
            pass
