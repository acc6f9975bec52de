"""A forked process says that it would hang; a spawned one works."""

import subprocess
import sys
import textwrap

FORK = """
import os, sys
import jax.numpy as jnp
{before}
import dbdnet_jax
from dbdnet_jax.io.forks import require_own_jax
require_own_jax("here")
child = os.fork()
if child == 0:
    try:
        {what}
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
"""


def forked(before: str, what: str) -> str:
    code = textwrap.dedent(FORK).format(before=before, what=what)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=100
    )
    assert not done.stderr, done.stderr
    return done.stdout


def test_a_process_forked_after_jax_was_used_says_so_at_once():
    said = forked("import dbdnet_jax.alignment.align; jnp.ones(3)", "dbdnet_jax.align(None, None)")
    assert said.startswith("align must not run in a process that was forked after JAX was used")
    assert 'multiprocessing.get_context("spawn")' in said


def test_weights_are_not_loaded_there_either():
    said = forked("import dbdnet_jax.io.forks; jnp.ones(3)", "dbdnet_jax.load_pretrained()")
    assert said.startswith("load_params must not run in a process that was forked")


def test_a_process_forked_before_jax_was_used_may_use_it():
    assert forked("", "require_own_jax('align'); print('fine', flush=True)") == "fine\n"
