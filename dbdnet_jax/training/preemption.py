"""Being asked to stop: by a scheduler (SIGTERM), a closed terminal (SIGHUP) or Ctrl-C (SIGINT)."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

import jax
from jax.experimental import multihost_utils

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


class Preempted(Exception):
    """A training was asked to stop and has saved its state; the text says where it goes on."""


class Interrupted(BaseException):
    """A signal came where there is nothing to save.

    Not KeyboardInterrupt: Python may end with a status of its own after one, caught or not.
    """


class StopRequest:
    """Whether one of the `SIGNALS` has come: ``name`` is the last one's, "" before."""

    name = ""

    def note(self, number: int, frame: FrameType | None) -> None:
        """Remember the signal; a second Ctrl-C does not wait for the next step."""
        again = self.name == signal.Signals.SIGINT.name
        self.name = signal.Signals(number).name
        if jax.distributed.is_initialized():
            os.kill(os.getpid(), signal.SIGTERM)  # JAX tells the other processes of that one
        if number == signal.SIGHUP:
            _leave_terminal()
        if again and number == signal.SIGINT:
            raise Interrupted

    def asked(self, step: int) -> str:
        """The signal after which to stop at ``step``, or "".

        With several processes it is the same step in all of them, soon after one got the signal.
        """
        if not jax.distributed.is_initialized():
            return self.name
        return "SIGTERM" if multihost_utils.reached_preemption_sync_point(step) else ""


@contextlib.contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Within it the `SIGNALS` only leave a note, which the caller reads where it can stop."""
    request = StopRequest()
    with _handled_by(request.note):
        yield request


@contextlib.contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Within it all of the `SIGNALS` raise `Interrupted`, at once."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            _leave_terminal()
        raise Interrupted

    with _handled_by(interrupt):
        yield


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Let ``handler`` take the `SIGNALS`; those that are ignored, as under nohup, stay ignored."""
    before = {}
    try:
        if threading.current_thread() is threading.main_thread():  # others may set no handler
            for number in SIGNALS:
                if jax.distributed.is_initialized() and number == signal.SIGTERM:
                    continue  # JAX listens to it, see `StopRequest.asked`
                if signal.getsignal(number) is not signal.SIG_IGN:
                    before[number] = signal.signal(number, handler)
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _leave_terminal() -> None:
    """Send what is printed nowhere where the terminal is gone: writing to it is an error."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), descriptor)
