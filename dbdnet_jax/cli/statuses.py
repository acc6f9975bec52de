"""The exit statuses, and failures as a line and a status."""

import os

from dbdnet_jax.errors import Failure
from dbdnet_jax.io.terminal import for_command_line, say

ALIGNED, UNSURE, UNUSABLE, FAILED, INTERRUPTED, UNREAD = 0, 1, 2, 3, 130, 141
DEBUG = "DBDNET_DEBUG"  # an environment variable


def say_failure(failure: Failure, origin: str = "") -> int:
    """Say what is the matter in one line, for a traceback tells most people nothing; its status."""
    if os.environ.get(DEBUG):
        say(*failure.where.splitlines(), to_stderr=True)
    hint = f" {DEBUG}=1 shows where it happened." if failure.kind == "unexpected" else ""
    origin = origin and f"{origin}: "
    say(f"error: {origin}{for_command_line(failure.message)}{hint}", to_stderr=True)
    return UNUSABLE if failure.kind == "input" else FAILED
