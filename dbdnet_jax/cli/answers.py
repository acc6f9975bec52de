"""What becomes of a pair, written and said."""

import json
from typing import Any

from dbdnet_jax.cli.jobs import Job
from dbdnet_jax.cli.one_pair import Answer
from dbdnet_jax.cli.statuses import ALIGNED, UNSURE, say_failure
from dbdnet_jax.errors import Failure, failure_of
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.io.terminal import say


def write_files(answer: Answer | Failure) -> Answer | Failure:
    """Write the files of an answer, each whole or not at all; a `Failure` where that fails."""
    try:
        for path, data in [] if isinstance(answer, Failure) else answer.files:
            write_atomic(path, data)
    except OSError as error:
        return failure_of(error)
    return answer


def show(job: Job, answer: Answer | Failure, *, as_json: bool) -> int:
    """Print an answer, or say what is the matter; the pair's exit status."""
    if as_json:
        say(as_line(as_record(job, answer)))
    if isinstance(answer, Failure):
        return say_failure(answer, job.pair.origin)
    if not as_json:
        say(*answer.summary)
    return ALIGNED if answer.valid else UNSURE


def as_record(job: Job, answer: Answer | Failure) -> dict[str, Any]:
    """What became of a pair: an alignment's numbers, or the kind of its failure and a message."""
    source, target = str(job.pair.source), str(job.pair.target)
    record = {"pair": job.pair.name} if job.pair.name else {}
    record |= {"source": source, "target": target}
    if isinstance(answer, Failure):
        return record | {"failure": answer.kind, "message": answer.message}
    return record | answer.numbers


def as_line(record: dict[str, Any]) -> str:
    """A record as one line that steers no terminal: JSON leaves one control character as it is."""
    return json.dumps(record).replace("\x7f", "\\u007f")
