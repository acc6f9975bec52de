"""The switches and helpers of `conftest` do what the tests rely on."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from dbdnet_jax.ops import rigid
from tests.conftest import EXACT, FLOAT32, assert_close, assert_finite, check_gradients


def test_signatures_are_checked_in_tests():
    with pytest.raises(TypeCheckError, match="points"):
        rigid.apply(rigid.identity(), jnp.zeros((5, 4)))


def test_signatures_are_not_checked_for_users():
    command = "import sys, dbdnet_jax.ops.rigid; sys.exit('beartype' in sys.modules)"
    subprocess.run([sys.executable, "-c", command], check=True, cwd=Path(__file__).parents[1])


def test_aligning_needs_no_library_of_training():
    """All that the train extra brings, and the others, are absent; the weights load and serve."""
    extras = """optax orbax grain h5py ml_collections tensorboardX distributed pyarrow open3d plotly
    matplotlib jinja2"""
    command = f"""
import sys
sys.modules.update(dict.fromkeys({extras.split()}))
import dbdnet_jax, dbdnet_jax.cli
dbdnet_jax.load_pretrained("cad")
"""
    subprocess.run([sys.executable, "-c", command], check=True, cwd=Path(__file__).parents[1])


def test_silent_rank_promotion_is_refused():
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.zeros((5, 3)) + jnp.zeros(3)


def test_there_are_two_devices():
    assert [device.platform for device in jax.devices()] == ["cpu", "cpu"]


def test_x64_is_switched_on_by_its_fixture(x64):
    assert jnp.zeros(1).dtype == jnp.float64


def test_x64_is_switched_off_elsewhere():
    assert jnp.asarray(np.zeros(1)).dtype == jnp.float32


@pytest.mark.parametrize(
    ("actual", "expected"),
    [
        ([1.0, np.nan], [1.0, np.nan]),
        ([1.0, 1.0], 1.0),
        ([[1.0, 1.0]], [1.0, 1.0]),
        ([1.0, 1.0001], [1.0, 1.0]),
    ],
)
def test_assert_close_refuses_nan_broadcasting_and_differences(actual, expected):
    with pytest.raises(AssertionError):
        assert_close(actual, expected, FLOAT32)
    with pytest.raises(AssertionError):
        assert_close(actual, expected, EXACT)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_assert_finite_names_the_leaf(bad):
    with pytest.raises(AssertionError, match="'b'"):
        assert_finite({"a": jnp.zeros(2), "b": jnp.asarray([0.0, bad])})


def test_check_gradients_refuses_a_wrong_derivative(x64):
    @jax.custom_vjp
    def wrong(x):
        return jnp.sum(x**2)

    wrong.defvjp(lambda x: (wrong(x), x), lambda x, g: (2.001 * g * x,))
    with pytest.raises(AssertionError):
        check_gradients(wrong, np.arange(3.0))
