"""What every test shares: the switches of JAX, named tolerances, and clouds that make trouble.

Tests run on the CPU with two XLA devices, refuse silent promotion of ranks and of types, and check
the shapes in the package's signatures (jaxtyping and beartype; users of the package pay nothing for
them). Compiled programs are shared by all workers and child processes of one session.
"""

import atexit
import functools
import os
import shutil
import signal
import tempfile
from pathlib import Path
from typing import NamedTuple

# A shell's background job ignores Ctrl-C, and nohup a closed terminal; tests send both.
for _name, _handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    _number = getattr(signal, _name, None)  # Windows has no SIGHUP
    if _number is not None and signal.getsignal(_number) == signal.SIG_IGN:
        signal.signal(_number, _handler)

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Nearly all of the tests' time is compilation; unoptimised code compiles twice as fast. Users run
# optimised code, and so does a weekly job.
if not os.environ.get("DBDNET_JAX_TESTS_OPTIMISED"):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"--xla_backend_optimization_level=0 {flags}"
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.mkdtemp(prefix="dbdnet_jax_tests_")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)

import flax.linen  # noqa: E402  the environment is read on import
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import optax  # noqa: E402
import pytest  # noqa: E402
from jax.test_util import check_grads  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
install_import_hook("dbdnet_jax", "beartype.beartype")


def _promoting(function):
    """``function`` and the functions that it gives, with JAX's standard promotion of types."""

    @functools.wraps(function)
    def promoted(*arguments, **options):
        with jax.numpy_dtype_promotion("standard"):
            found = function(*arguments, **options)
        if callable(found):
            return _promoting(found)
        if isinstance(found, optax.GradientTransformation):
            return found._replace(update=_promoting(found.update))
        return found

    return promoted


# optax takes powers and cosines of its int32 counts of steps.
for _name in ("adam", "adamw", "cosine_decay_schedule", "warmup_cosine_decay_schedule"):
    setattr(optax, _name, _promoting(getattr(optax, _name)))
# Flax asks for the wider one of float32 and the type that is normalised.
flax.linen.LayerNorm.__call__ = _promoting(flax.linen.LayerNorm.__call__)


# Folders and files whose tests are marked fast: together under two minutes on two idle cores.
FAST = """
io metrics ops/test_normals.py ops/test_rigid.py ops/test_sinkhorn.py
classical/test_refine.py networks/test_weights.py networks/dbdnet/test_released.py
data/test_surface.py data/test_modelnet40.py training/test_optimizer.py training/test_stages.py
alignment/test_candidates.py alignment/test_quality.py alignment/test_surfaces.py
alignment/test_voxels.py evaluation/test_tables.py drawing/test_evaluation_page.py
cli/test_arguments.py test_structure.py test_guards.py
""".split()


def pytest_collection_modifyitems(items):
    """Mark the tests of `FAST`."""
    here = Path(__file__).parent
    for item in items:
        path = item.path.relative_to(here)
        if {str(path), path.parts[0]} & set(FAST):
            item.add_marker("fast")


@pytest.fixture(scope="module", autouse=True)
def programs_of_other_modules_are_forgotten():
    """Every compiled program holds memory maps, of which Linux gives a process 65,530.

    A worker that kept all of them would end in a segmentation fault while compiling.
    """
    yield
    jax.clear_caches()


class Tolerance(NamedTuple):
    """``|actual - expected| <= atol + rtol * |expected|``."""

    rtol: float
    atol: float


# The same sum of about a hundred terms of order one, in another order, at eps 1.2e-7.
FLOAT32 = Tolerance(rtol=1e-5, atol=1e-5)
# The same at eps 2.2e-16, with room for a sum of squares and a square root.
FLOAT64 = Tolerance(rtol=1e-9, atol=1e-10)
# Central differences in float64, steps of 1e-6, of sums of order a hundred: rounding leaves 1e-8,
# third derivatives of a thousand leave 1e-9.
GRADIENT = Tolerance(rtol=1e-6, atol=1e-6)
# Nothing is recomputed in another order: only moved, masked or left alone.
EXACT = Tolerance(rtol=0.0, atol=0.0)


def assert_close(actual, expected, tolerance: Tolerance) -> None:
    """Same shapes, no NaN on either side, and every entry within ``tolerance``."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"shapes {actual.shape} and {expected.shape}"
    np.testing.assert_allclose(
        actual, expected, rtol=tolerance.rtol, atol=tolerance.atol, equal_nan=False
    )


def assert_finite(tree) -> None:
    """No NaN and no infinity in any leaf."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert np.all(np.isfinite(leaf)), f"{jax.tree_util.keystr(path)}: {leaf}"


def check_gradients(function, *arrays) -> None:
    """The reverse derivative of a scalar function is that of central differences (needs x64)."""
    check_grads(
        jax.jit(function),
        [jnp.asarray(x, jnp.float64) for x in arrays],
        order=1,
        modes=["rev"],
        eps=1e-6,
        atol=GRADIENT.atol,
        rtol=GRADIENT.rtol,
    )


class Precision(NamedTuple):
    """A floating-point type and what may be asked of it."""

    dtype: np.dtype
    tolerance: Tolerance


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """Runs the test once in float32 and once, with x64 switched on for it alone, in float64."""
    with jax.enable_x64(request.param == "float64"):
        yield Precision(np.dtype(request.param), FLOAT64 if request.param == "float64" else FLOAT32)


@pytest.fixture
def x64():
    """Float64 for one test."""
    with jax.enable_x64(True):
        yield


def random_cloud(seed: int, n: int, width: int = 3) -> np.ndarray:
    """(n, width) float64 points, uniform in the cube [-1, 1]^width."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, width))


def degenerate_clouds(n: int = 24) -> dict[str, np.ndarray]:
    """(n, 3) float64 clouds on which neighbours, distances and rotations are not unique."""
    points = random_cloud(99, n)
    line = points[:, :1] * np.array([[0.3, -0.5, 0.8]])
    grid = np.stack(np.meshgrid(np.arange(n // 3), np.arange(3), 0.0), axis=-1).reshape(-1, 3)
    return {
        "coplanar": points * np.array([[1.0, 1.0, 0.0]]),
        "tilted plane": points @ np.array([[1, 0, 1], [0, 1, -1], [0, 0, 0.0]]) + 0.3,
        "grid": grid / n,
        "collinear": line,
        "shifted line": line + np.array([[0.1, 0.7, -0.4]]),
        "duplicated": np.repeat(points[: n // 4], 4, axis=0),
        "two places": np.repeat(points[:2], n // 2, axis=0),
        "identical": np.repeat(points[:1], n, axis=0),
        "zero": np.zeros((n, 3)),
    }


@pytest.fixture(params=list(degenerate_clouds()))
def degenerate(request) -> np.ndarray:
    """One cloud after the other of ``degenerate_clouds``."""
    return degenerate_clouds()[request.param]
