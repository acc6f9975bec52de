"""Small pickles that would take for ever are refused before they are loaded."""

import io
import pickle
import time

import numpy as np
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.pickle_bounds import check_pickle

TWICE = b"h\x00h\x00\x86q\x00"  # what is remembered, twice in a tuple, and remembered


def doubled_lists(levels: int) -> list:
    held: list = []
    for _ in range(levels):
        held = [held, held]
    return held


BOMBS = {
    "key": (b"\x80\x02})q\x00" + TWICE * 60 + b"K\x01s.", "64 parts for each opcode"),
    "deep key": (b"\x80\x02})" + b"\x85" * 100_000 + b"K\x01s.", "200 levels"),
    "set": (b"\x80\x04\x8f()q\x00" + TWICE * 60 + b"\x90.", "64 parts for each opcode"),
    "frozen set": (b"\x80\x04()q\x00" + TWICE * 60 + b"\x91.", "64 parts for each opcode"),
    "call": (b"\x80\x02cbuiltins\nset\n)q\x00" + TWICE * 60 + b"\x85R.", "64 parts"),
    "lists": (pickle.dumps(doubled_lists(60)), "64 parts for each opcode"),
    "equal hashes": (
        pickle.dumps({(2**61 - 1) << n: n for n in range(10, 200)}),
        "100 numbers of more than 64 bits",
    ),
    "more than it has": (b"\x80\x02s.", "takes more than it has|damaged"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_would_grow_is_refused_at_once(name):
    data, message = BOMBS[name]
    start = time.process_time()
    with pytest.raises((CheckpointError, IndexError), match=message):
        check_pickle(io.BytesIO(data))
    assert time.process_time() - start < 2


@pytest.mark.parametrize("protocol", range(6))
def test_what_is_honest_passes_and_the_stream_stands_behind_it(protocol):
    shared = ("a", "b", (1, 2.5, None))
    held = {
        "arrays": [np.ones((2, 3))] * 50,
        "tuples": {i: shared for i in range(500)},
        "sets": {frozenset({i}) for i in range(50)},
        "large": 2**77,
    }
    data = pickle.dumps(held, protocol)
    stream = io.BytesIO(data + b"more")
    check_pickle(stream)
    assert stream.tell() == len(data)


def test_opcodes_are_counted():
    with pytest.raises(CheckpointError, match="at most 50 opcodes"):
        check_pickle(io.BytesIO(pickle.dumps(list(range(100)), 0)), 50)
