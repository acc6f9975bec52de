"""The step and the loop: the same result however often a run is stopped, and no bad state kept."""

import dataclasses
import functools
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.lock import LOCK
from dbdnet_jax.training.optimizer import make_optimizer, make_schedule
from dbdnet_jax.training.parallel import on_all_devices, training_mesh
from dbdnet_jax.training.preemption import Preempted
from dbdnet_jax.training.step import init_state, train_step
from tests import stand_in
from tests.conftest import EXACT, FLOAT32, assert_close, assert_finite

STEPS = 12


class Stopped(Exception):
    """What stops a run in a test."""


def state_like():
    """A state with the structure of the stand-in's."""
    schedule = make_schedule(stand_in.RATE, STEPS, 2)
    optimizer = make_optimizer(schedule, weight_decay=0.0, clip_norm=1.0)
    return init_state(stand_in.task().trainable, optimizer, ema_decay=0.9)


def final_state(folder: Path):
    with Checkpoints(folder) as checkpoints:
        step = checkpoints.latest_step()
        return step, checkpoints.restore(step, state_like())


def assert_same_run(folder: Path, other: Path) -> None:
    """The same states, bit for bit, and the same curves, byte for byte."""
    (step, found), (other_step, expected) = final_state(folder), final_state(other)
    assert step == other_step
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)
    for name in ("train.csv", "validation.csv"):
        assert (folder / name).read_bytes() == (other / name).read_bytes()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory) -> Path:
    """The folder of a run that nobody stopped."""
    folder = tmp_path_factory.mktemp("unbroken")
    stand_in.train(folder)
    return folder


def test_a_run_leaves_its_curves_and_lowers_the_loss(unbroken):
    step, state = final_state(unbroken)
    assert step == int(state.step) == STEPS
    rows = np.genfromtxt(unbroken / "train.csv", delimiter=",", names=True)
    assert rows.dtype.names == ("step", "fit", "size", "loss", "gradient_norm", "learning_rate")
    assert list(rows["step"]) == list(range(1, STEPS + 1))
    np.testing.assert_allclose(rows["fit"] + rows["size"], rows["loss"], rtol=1e-6)
    validation = np.genfromtxt(unbroken / "validation.csv", delimiter=",", names=True)
    assert list(validation["step"]) == [4, 8, 12]
    assert validation["error"][-1] < validation["error"][0]
    assert list((unbroken / "tensorboard").glob("events.*"))


def test_the_rate_warms_up_over_epochs(unbroken):
    rows = np.genfromtxt(unbroken / "train.csv", delimiter=",", names=True)
    # One epoch of warm-up, which is two steps of four of the eight shapes.
    schedule = make_schedule(stand_in.RATE, STEPS, 2)
    np.testing.assert_allclose(rows["learning_rate"], [schedule(i) for i in range(STEPS)])


def written(folder: Path) -> dict[Path, int]:
    """When each file was written, but for the lock, which says who looked last."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != LOCK}


def test_two_runs_are_the_same_and_a_finished_one_stays(unbroken, tmp_path):
    stand_in.train(tmp_path)
    assert_same_run(tmp_path, unbroken)
    before = written(tmp_path)
    stand_in.train(tmp_path)
    assert written(tmp_path) == before


@pytest.mark.parametrize("stops", [(7,), (1, 3, 4, 11)])
def test_a_stopped_run_ends_as_an_unbroken_one(unbroken, tmp_path, stops):
    pairs = stand_in.source()
    for stop in stops:

        def arrays(start, stop=stop):
            for step, these in enumerate(pairs.arrays(start), start=start):
                if step == stop:
                    raise Stopped
                yield these

        with pytest.raises(Stopped):
            stand_in.train(tmp_path, pairs._replace(arrays=arrays))
    stand_in.train(tmp_path)
    assert_same_run(tmp_path, unbroken)


def test_trained_networks_are_judged_once_before_the_first_step(tmp_path):
    task = stand_in.task()._replace(networks=("matrix", "offset"))
    pairs = stand_in.source()

    def killed_at_once(start):
        raise Stopped
        yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stand_in, "task", lambda: task)
        for _ in range(2):
            with pytest.raises(Stopped):
                stand_in.train(tmp_path, pairs._replace(arrays=killed_at_once))
        stand_in.train(tmp_path)
    rows = np.genfromtxt(tmp_path / "validation.csv", delimiter=",", names=True)
    assert list(rows["step"]) == [0, 4, 8, 12]


def test_a_signal_within_a_row_of_the_log_leaves_no_trace(tmp_path):
    config = dataclasses.replace(stand_in.TRAIN, log_every=4, checkpoint_every=4)
    stand_in.train(tmp_path / "unbroken", config=config)
    pairs = stand_in.source()

    def arrays(start):
        for step, these in enumerate(pairs.arrays(start), start=start):
            if step == 5:
                signal.raise_signal(signal.SIGTERM)
            yield these

    with pytest.raises(Preempted, match="SIGTERM; the state after step 6 of 12 is saved in"):
        stand_in.train(tmp_path / "stopped", pairs._replace(arrays=arrays), config)
    stand_in.train(tmp_path / "stopped", config=config)
    assert_same_run(tmp_path / "stopped", tmp_path / "unbroken")


def broken_source(bad: int):
    """Pairs whose ``bad``-th is NaN, as one damaged shape would make it."""
    pairs = stand_in.source()

    def draw(key, number, arrays):
        pair = pairs.draw(key, number, arrays)
        points = jnp.where(number == bad, jnp.nan, pair.target.points)
        return pair._replace(target=pair.target._replace(points=points))

    return pairs._replace(draw=draw)


@pytest.mark.parametrize("bad_step", [0, 6, 7])
def test_nan_in_the_data_stops_with_the_last_good_state(unbroken, tmp_path, bad_step):
    message = rf"'fit' is nan in the step after step {bad_step} .* kept: .*{bad_step or 'none'}"
    with pytest.raises(FloatingPointError, match=message):
        stand_in.train(tmp_path, broken_source(bad_step * stand_in.BATCH + 2))
    with Checkpoints(tmp_path) as checkpoints:
        assert (checkpoints.latest_step() or 0) == bad_step
        if bad_step:
            assert_finite(checkpoints.restore(bad_step, state_like()))
    stand_in.train(tmp_path)  # the data mended, the run goes on as if nothing had been
    (_, found), (_, expected) = final_state(tmp_path), final_state(unbroken)
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)


def test_a_gradient_that_is_not_finite_is_named_too(tmp_path):
    def loss(trainable, frozen, pair, key):
        terms = stand_in.Terms(jnp.sqrt(jnp.sum(0 * trainable["offset"])), jnp.zeros(()))
        return terms.fit, terms

    task = stand_in.task()._replace(loss=loss)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stand_in, "task", lambda: task)
        with pytest.raises(FloatingPointError, match="'gradient_norm' is nan in the step"):
            stand_in.train(tmp_path)


def test_a_validation_that_is_not_finite_stops_too(tmp_path):
    validation = stand_in.source().validation
    points = validation.target.points.at[1].set(jnp.inf)
    validation = validation._replace(target=validation.target._replace(points=points))
    with pytest.raises(FloatingPointError, match="'error' is .* in the validation after step 4"):
        stand_in.train(tmp_path, stand_in.source()._replace(validation=validation))
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest_step() == 4 and checkpoints.best_step() is None


def step_once(batch_size: int, ema_decay: float = 0.0, bad: int = -1):
    """One plain gradient step (rate 1) of the stand-in, from step 3; old state, new, metrics."""
    pairs = stand_in.source() if bad < 0 else broken_source(bad)
    optimizer = optax.sgd(1.0)
    task = stand_in.task()
    state = init_state(task.trainable, optimizer, ema_decay=ema_decay)
    state = state.replace(step=jnp.asarray(3, jnp.int32))
    arguments = (state, None, jax.random.key(0), next(pairs.arrays(0)))

    @jax.jit
    def step(*arguments):
        return train_step(
            *arguments,
            draw=pairs.draw,
            loss=task.loss,
            optimizer=optimizer,
            batch_size=batch_size,
            mesh=mesh,
            ema_decay=ema_decay,
        )

    mesh = training_mesh(batch_size)
    return state, *step(*on_all_devices(mesh, arguments))


@pytest.mark.parametrize("batch_size", [1, 4, 5])
def test_a_step_takes_the_mean_gradient_of_its_pairs(batch_size):
    state, new, metrics = step_once(batch_size)
    pairs, task = stand_in.source(), stand_in.task()
    key = jax.random.fold_in(jax.random.key(0), 3)
    points = jnp.asarray(next(pairs.arrays(0)))

    @jax.jit
    def one(i):
        draw_key, loss_key = jax.random.split(jax.random.fold_in(key, i))
        pair = pairs.draw(draw_key, 3 * batch_size + i, points)
        return jax.value_and_grad(task.loss, has_aux=True)(task.trainable, None, pair, loss_key)

    found = [one(i) for i in range(batch_size)]
    losses = [loss for (loss, _), _ in found]
    gradients = [gradient for _, gradient in found]
    expected = jax.tree.map(lambda *leaves: sum(leaves) / batch_size, *gradients)
    assert_close(metrics.loss, np.mean(losses), FLOAT32)
    assert_close(metrics.gradient_norm, optax.tree.norm(expected), FLOAT32)
    found = jax.tree.map(lambda old, moved: old - moved, state.params, new.params)
    jax.tree.map(lambda a, b: assert_close(a, b, FLOAT32), found, expected)
    assert int(new.step) == 4 and metrics.finite


def test_a_bad_step_changes_nothing():
    state, new, metrics = step_once(4, ema_decay=0.5, bad=3 * 4 + 1)
    assert not metrics.finite and np.isnan(metrics.terms.fit) and np.isfinite(metrics.terms.size)
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), new, state)


def test_recomputation_is_a_part_of_the_step_where_it_is_asked_for():
    pairs, task, optimizer = stand_in.source(), stand_in.task(), optax.sgd(1.0)
    state, mesh = init_state(task.trainable, optimizer), training_mesh(4)
    options = {"draw": pairs.draw, "loss": task.loss, "optimizer": optimizer, "mesh": mesh}
    rest = None, jax.random.key(0), next(pairs.arrays(0))

    def text(remat):
        step = functools.partial(train_step, batch_size=4, remat=remat, **options)
        return str(jax.make_jaxpr(step)(state, *rest))

    assert "remat" in text(True) or "checkpoint" in text(True)
    assert "remat" not in text(False) and "checkpoint" not in text(False)


def test_parts_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(ValueError, match="must divide .* got 3 for 2. Use 1"):
        stand_in.train(tmp_path, config=dataclasses.replace(stand_in.TRAIN, accumulate=3))
    batch_norms = stand_in.task()._replace(batch_stats={"mean": jnp.zeros(3)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stand_in, "task", lambda: batch_norms)
        with pytest.raises(ValueError, match="must be 1 for a network with batch norms.*got 2"):
            stand_in.train(tmp_path, config=dataclasses.replace(stand_in.TRAIN, accumulate=2))
    assert not list(tmp_path.iterdir())


def test_the_average_has_a_short_memory_at_first():
    state, new, _ = step_once(4, ema_decay=0.999)
    decay = (1 + 3) / (10 + 3)
    expected = jax.tree.map(lambda a, b: decay * a + (1 - decay) * b, state.ema, new.params)
    jax.tree.map(lambda a, b: assert_close(a, b, FLOAT32), new.ema, expected)


def test_the_rate_may_stay_until_the_last_steps():
    def schedule(steps, decay=20):
        return make_schedule(0.5, steps, 9, kind="constant", decay_steps=decay)

    rates = [float(schedule(100)(step)) for step in range(101)]
    np.testing.assert_allclose(rates[:10], 0.05 * np.arange(1, 11), rtol=1e-6)
    np.testing.assert_allclose(rates[9:81], 0.5, rtol=1e-6)
    assert np.all(np.diff(rates[80:]) < 0) and rates[100] < 1e-6
    # More steps change nothing of those before the decay.
    assert [float(schedule(500)(step)) for step in range(80)] == rates[:80]
    assert float(schedule(100, 0)(100)) == 0.5
