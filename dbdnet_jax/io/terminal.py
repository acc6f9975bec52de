"""What is printed: one line at a time, with nothing in it that would steer the terminal."""

import os
import re
import sys
from typing import TextIO


def printable(text: str) -> str:
    """``text`` with an escape for every character that is no sign or space.

    Control characters move the cursor and hide lines, marks of direction turn names round, and a
    file's name may hold any of them; half a surrogate pair, a byte of a name that is no text, could
    not be printed at all.
    """
    return "".join(x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)


def say(*lines: str, to_stderr: bool = False) -> None:
    """Print lines at once; where the stream is closed, or there is none, nothing.

    Raises:
      BrokenPipeError: nobody reads standard output any more.
      OSError: standard output cannot be written.
    """
    stream: TextIO | None = sys.stderr if to_stderr else sys.stdout
    if stream is None:  # print would then take the other one
        return
    try:
        for line in lines:
            print(printable(line), file=stream)
        stream.flush()
    except OSError:
        if not to_stderr:
            _mute_stdout()
            raise
    except ValueError:  # of a closed file
        pass


def _mute_stdout() -> None:
    """Let what is still in standard output's buffer go nowhere, without a word at exit."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError, AttributeError):  # no stream, or none of a file
        pass


def for_command_line(text: str) -> str:
    """Advice for Python as advice for the command line: ``initial=`` is ``--initial``."""
    options = "initial|scale|overlap_threshold|max_points|seed|search"

    def option(found: re.Match[str]) -> str:
        return f"--{found[1].replace('_', '-')}{found[2] and ' '}{found[2]}{found[3]}"

    text = re.sub(rf"`*\b({options})=['\"]?([\w.]*)['\"]?`*()", option, text)
    text = re.sub(rf"^({options})()( must)", option, text)
    # What to type in Python to mend an array does not mend a file.
    return re.sub(
        r"(Rows are points: )?[Gg]ive [^ ]*(points|values)[.[].*$", "Mend the file.", text
    )
