"""What a pickle would cost to load, told from its opcodes before one of them has run.

A few hundred bytes can name one tuple twice in the next, and that twice again: a thing of 2^60
parts, which a dictionary hashes one by one when it is a key, and which an error would print.
"""

from __future__ import annotations

import pickletools
from typing import Any

from dbdnet_jax.errors import CheckpointError

MOST_OPCODES = 4_000_000  # many seconds; 3DMatch's list of pairs has a million
MOST_OPCODES_OF_TENSORS = 500_000  # of 16,000 tensors; the released network has 700
MOST_PARTS_PER_OPCODE = 64  # a thing that others share is counted in each; honest files have 10
DEEPEST = 200  # of things in things; hashing recurses on the C stack, which ends without an error

MOST_LARGE_NUMBERS = 100  # torch writes one; those that differ by 2^61 - 1 have the same hash

_TUPLES = {"TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_TUPLE", "FROZENSET"}
_MARK = pickletools.markobject
_PUTS = {"PUT", "BINPUT", "LONG_BINPUT"}
_GETS = {"GET", "BINGET", "LONG_BINGET"}


class _Parts:
    """How many parts a thing has, those of its parts included, and how deep they lie."""

    __slots__ = ("count", "depth")

    def __init__(self, parts: list[Any]):
        self.count, self.depth = 1, 1
        self.take(parts)

    def take(self, parts: list[Any]) -> None:
        """Put parts into it."""
        for part in parts:
            self.count += part.count
            if part.depth >= self.depth:
                self.depth = part.depth + 1


def check_pickle(stream: Any, most_opcodes: int = MOST_OPCODES) -> None:
    """Read one pickle's opcodes from the stream, up to its end.

    Raises:
      CheckpointError: what is loaded would be far larger than what stands there, or an opcode is
        one that ``pickle`` does not write.
    """
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    leaf, large = _Parts([]), 0
    opcodes: Any = pickletools.genops(stream)
    for number, (opcode, argument, _) in enumerate(opcodes):
        name, before = opcode.name, opcode.stack_before
        if number > most_opcodes:
            raise CheckpointError(
                f"A pickle must have at most {most_opcodes} opcodes; it has more. Give a file of "
                "fewer tensors or arrays."
            )
        # Extension codes get round find_class, and the C unpickler allocates its memo up to the
        # largest slot named.
        far = "PUT" in name and int(argument or 0) > number
        if far or name.startswith("EXT"):
            raise CheckpointError(
                f"pickle does not write {name} {argument} here. Do not trust the file."
            )
        if name in _PUTS or name == "MEMOIZE":
            memo[len(memo) if name == "MEMOIZE" else int(argument)] = stack[-1]
            continue
        if name in _GETS:
            stack.append(memo[int(argument)])
            continue
        if not before:
            if opcode.stack_after:
                stack.append(_MARK if name == "MARK" else _Parts([]) if "EMPTY" in name else leaf)
            large += type(argument) is int and argument.bit_length() > 64
            if large > MOST_LARGE_NUMBERS:
                raise CheckpointError(
                    f"A pickle must hold at most {MOST_LARGE_NUMBERS} numbers of more than 64 "
                    "bits; it holds more. Do not trust the file."
                )
            continue
        taken = _pop(stack, before)
        if name == "DUP":
            stack += taken * 2
        elif opcode.stack_after:
            held = taken[0] if taken and before[0] is not _MARK and name not in _TUPLES else None
            if isinstance(held, _Parts) and held is not leaf and _mutates(name):
                held.take(taken[1:])
            else:
                held = _Parts(taken)
            stack.append(held)
            _refuse_excess(held, number)


def _mutates(name: str) -> bool:
    """Whether an opcode puts what it takes into the first thing it takes."""
    return name in {"APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"}


def _pop(stack: list[Any], before: list[Any]) -> list[Any]:
    """What an opcode takes off the stack, its mark left out."""
    start = len(stack) - len(before)
    if _MARK in before:
        last = len(stack) - 1
        while last >= 0 and stack[last] is not _MARK:
            last -= 1
        start = last - before.index(_MARK)
    if start < 0:
        raise CheckpointError("The file's pickle takes more than it has. Fetch it again.")
    taken = [part for part in stack[start:] if part is not _MARK]
    del stack[start:]
    return taken


def _refuse_excess(held: _Parts, number: int) -> None:
    most = MOST_PARTS_PER_OPCODE * (number + 100)
    if held.count > most or held.depth > DEEPEST:
        raise CheckpointError(
            f"A pickle must have at most {DEEPEST} levels and {MOST_PARTS_PER_OPCODE} parts for "
            f"each opcode; opcode {number} makes a thing of {held.count} parts in {held.depth} "
            "levels. Do not trust the file."
        )
