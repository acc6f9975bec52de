"""Attacks by damage to kept programs, pickles, weights and checkpoints."""

import collections
import os
import pickle
import random
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import dbdnet_jax
from benchmarks.machine import peak_gib
from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.torch_pickle import load_pickle
from dbdnet_jax.networks.weights import load_params
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.step import init_state

LONGEST_S = 60.0  # to read or refuse one small file
ALIGN_ONCE = """
from benchmarks.attacks.drawn import drawn_pairs
from dbdnet_jax import align
from dbdnet_jax.io.programs import keep_compiled_programs
keep_compiled_programs()
pair, _ = next(drawn_pairs(1))
print(align(pair.source, pair.target).transform.tobytes().hex())
"""


def damaged(content: bytes, draw: random.Random) -> bytes:
    """The content with some bytes changed, cut or lengthened."""
    changed = bytearray(content)
    for _ in range(draw.choice([1, 1, 4, 64])):
        changed[draw.randrange(len(changed))] = draw.randrange(256)
    how = draw.randrange(4)
    if how == 1:
        del changed[draw.randrange(len(changed)) :]
    elif how == 2:
        changed += draw.randbytes(draw.randrange(1, 100))
    return bytes(changed)


def through_programs(count: int) -> bool:
    """Whether new processes give the answer whatever happened to the programs that are kept."""
    draw, answers = random.Random(7), []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": folder}
        for _ in range(count + 1):
            command = [sys.executable, "-W", "ignore", "-c", ALIGN_ONCE]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            answers.append(done.stderr[-300:] if done.returncode else done.stdout.strip())
            for path in draw.sample(sorted(Path(folder).glob("*-cache")), 1) + draw.sample(
                sorted(Path(folder).glob("*.stablehlo")), 1
            ):
                path.write_bytes(damaged(path.read_bytes(), draw))
    same = sum(answer == answers[0] for answer in answers[1:])
    print(f"{same} of {count} processes got the answer of the first")
    for answer in set(answers) - {answers[0]}:
        print(f"    {answer}")
    return same == count


def through_files(
    count: int, content: bytes, name: str, read: Callable[[Path], object], expected: object
) -> bool:
    """Whether a damaged file is read as it was, as other values, or refused in words, and soon."""
    draw, said = random.Random(11), collections.Counter[str]()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        for _ in range(count):
            path.write_bytes(damaged(content, draw))
            start = time.perf_counter()
            try:
                said["as it was" if read(path) == expected else "other values"] += 1
            except (CheckpointError, ValueError, OSError) as error:
                named = str(path) in str(error)  # as a library's own error would not
                said["refused" if named else f"wrong: {error!r:.80}"] += 1
            except Exception as error:
                said[f"wrong: {error!r:.80}"] += 1
            slowest = max(slowest, time.perf_counter() - start)
    listed = ", ".join(f"{number} {what}" for what, number in said.most_common())
    print(f"{name}: {listed}; {slowest:.1f} s at most, {peak_gib()} GiB")
    return slowest < LONGEST_S and not any(what.startswith("wrong") for what in said)


def through_pickles(count: int) -> bool:
    """Pickles of arrays, and the weights in the package."""
    values = {"points": np.arange(300.0).reshape(100, 3), "names": ["a", "b"], "more": (1, 2.5)}
    arrays = through_files(
        count,
        pickle.dumps(values),
        "scan.pkl",
        lambda path: str(load_pickle(path)),
        str(values),
    )
    weights = Path(dbdnet_jax.__file__).parent / "networks" / "pretrained" / "cad.npz"
    return arrays & through_files(
        count // 10, weights.read_bytes(), "weights.npz", lambda path: bool(load_params(path)), True
    )


def through_checkpoints(count: int) -> bool:
    """Whether a training goes on from one of two checkpoints whatever happened to the newer one."""
    draw, said = random.Random(13), collections.Counter[str]()
    optimizer = optax.adamw(1e-3)
    like = init_state({"kernel": jnp.zeros((64, 64)), "bias": jnp.zeros(7)}, optimizer)
    saved = [jax.tree.map(lambda leaf, n=n: leaf + n, like) for n in (1, 2)]
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            with Checkpoints(Path(folder)) as checkpoints:
                for step, state in enumerate(saved, start=1):
                    checkpoints.save(step, state)
            newest = Path(folder) / "checkpoints" / "2"
            path = draw.choice(sorted(path for path in newest.rglob("*") if path.is_file()))
            if draw.randrange(4):
                path.write_bytes(damaged(path.read_bytes() or b"0", draw))
            else:
                path.unlink()
            with warnings.catch_warnings(), Checkpoints(Path(folder)) as checkpoints:
                warnings.simplefilter("ignore")
                resumed = checkpoints.resume(like)
            step = resumed.step if resumed else 0
            same = step and jax.tree.all(
                jax.tree.map(lambda a, b: bool((a == b).all()), resumed.state, saved[step - 1])
            )
            said[f"went on from {step}" if same else "wrong"] += 1
    print("checkpoints: " + ", ".join(f"{number} {what}" for what, number in said.items()))
    return "wrong" not in said
