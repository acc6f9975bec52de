"""A process that was forked after JAX was used, which would wait for ever for JAX's threads."""

import os
import sys


def require_own_jax(what: str) -> None:
    """Refuse to use JAX in a process that was forked from one that had used it.

    Raises:
      RuntimeError: this is such a process; ``what`` begins the sentence.
    """
    if _STATE["forked"]:
        raise RuntimeError(
            f"{what} must not run in a process that was forked after JAX was used: JAX's threads "
            f"stayed behind, and it would wait for ever; process {os.getpid()} was. Start workers "
            'with multiprocessing.get_context("spawn"), or use threads.'
        )


def _note_fork() -> None:
    # There is no public way to ask whether JAX is in use without starting it.
    jax = sys.modules.get("jax._src.xla_bridge")
    if jax is not None and jax.backends_are_initialized():
        _STATE["forked"] = True


_STATE = {"forked": False}
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)
