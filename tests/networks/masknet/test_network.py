"""MaskNet against its authors' code, run in float64 on weights drawn by a rule."""

import re
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax.traverse_util import flatten_dict

from dbdnet_jax.networks.batch_norm import fold, join_batch_stats, split_batch_stats
from dbdnet_jax.networks.masknet.network import MaskNet, MaskNetConfig, predict, shapes
from dbdnet_jax.networks.params import unflatten
from dbdnet_jax.training.masknet import mask_loss
from dbdnet_jax.types import Cloud
from tests.conftest import Tolerance, assert_close, random_cloud

BUNDLE = Path(__file__).parents[4] / "shared" / "peers" / "masknet_golden.npz"
CONFIG = MaskNetConfig()
SMALL = MaskNetConfig(encoder=(8, 16), head=(16, 8))
# Of the largest entry: a float64 port may differ by 1e-13; float32 marks what is stored rounded.
EVAL, TRAIN, STORED = 1e-10, 1e-9, 1e-7

released = pytest.mark.skipif(
    not BUNDLE.exists(), reason="../shared/peers with the authors' outputs is not there"
)


def torch_name(name: str) -> str:
    """Theirs for ours."""
    leaf = name.rsplit("/", 1)[1]
    leaf = {"kernel": "weight", "scale": "weight", "mean": "running_mean"}.get(leaf, leaf)
    leaf = leaf.replace("variance", "running_var")
    if found := re.match(r"masknet/encoder_(\d)/(conv|batch_norm)/", name):
        kind = "conv" if found[2] == "conv" else "bn"
        return f"maskNet.feature_model.{kind}{int(found[1]) + 1}.{leaf}"
    return f"maskNet.h3.{2 * int(re.match(r'masknet/head_(.)', name)[1])}.{leaf}"


def filled(golden) -> dict:
    """The network's tree by the bundle's rule, in float64."""
    arrays = {}
    for name, shape in shapes(CONFIG).items():
        theirs = torch_name(name)
        torch_shape = (*shape[::-1], 1) if len(shape) == 2 else shape
        rng = np.random.default_rng([int(golden["fill/seed"]), zlib.crc32(theirs.encode())])
        if theirs.endswith("running_var"):
            value = 0.5 + rng.random(torch_shape)
        elif len(shape) == 2:
            value = rng.standard_normal(torch_shape) * np.sqrt(2 / np.prod(torch_shape[1:]))
        else:
            value = 0.1 * rng.standard_normal(torch_shape) + theirs.endswith(".weight")
        value = golden.get(f"override/{theirs}", value.astype(np.float32)).astype(np.float64)
        check = golden.get(f"fill/check/{theirs}")
        assert check is None or np.array_equal(value, check)
        arrays[name] = value.reshape(torch_shape[: len(shape)]).T
    return unflatten(arrays, CONFIG).networks["masknet"]


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    return dict(np.load(BUNDLE))


def assert_near(found, expected, part: float) -> None:
    expected = np.asarray(expected)
    part = max(part, STORED) if expected.dtype == np.float32 else part
    atol = part * max(float(np.max(np.abs(expected))), 1e-12)
    assert_close(found, expected.astype(np.float64), Tolerance(0.0, atol))


def mean_squares(trainable, stats, golden, mode: str):
    """Loss, and the logits with the new averages, as their code has them."""
    clouds = (jnp.asarray(golden[k], jnp.float64) for k in ("source", "template"))
    network = MaskNet(CONFIG)
    if mode == "train":
        variables = {"params": trainable, "batch_stats": stats}
        logits, changed = network.apply(variables, *clouds, training=True, mutable=["batch_stats"])
        changed = changed["batch_stats"]
    else:
        variables = {"params": fold(join_batch_stats(trainable, stats))}
        logits, changed = network.apply(variables, *clouds), None
    labels = golden["template_mask_gt"] > 0.5
    return mask_loss(logits, labels, np.ones_like(labels)), (logits, changed)


@released
@pytest.mark.parametrize(("mode", "part"), [("eval", EVAL), ("train", TRAIN)])
def test_mask_loss_and_gradients_are_the_authors(golden, x64, mode, part):
    trainable, stats = split_batch_stats(filled(golden))
    function = jax.jit(
        jax.value_and_grad(lambda t: mean_squares(t, stats, golden, mode), has_aux=True)
    )
    (loss, (logits, changed)), gradient = function(trainable)
    assert_near(logits, golden[f"{mode}/mask_logit"], part)
    assert_near(jax.nn.sigmoid(logits), golden[f"{mode}/mask"], part)
    assert np.array_equal(logits > 0, golden[f"{mode}/threshold_mask"] == 1)
    top = np.sort(np.argsort(-np.asarray(logits), axis=1)[:, : golden["source"].shape[1]], axis=1)
    assert np.array_equal(top, golden[f"{mode}/topk_index"])
    assert_near(loss, golden[f"{mode}/loss_mse"], part)
    norms = {torch_name(f"masknet/{k}"): np.linalg.norm(v) for k, v in flat(gradient).items()}
    prefix = f"{mode}/grad_norm/"
    expected = {k.removeprefix(prefix): v for k, v in golden.items() if k.startswith(prefix)}
    assert norms.keys() == expected.keys()
    # Those that are zero by symmetry are noise: a floor of 1e-9 of the largest.
    floor = 1e-9 * max(map(float, expected.values()))
    for name, norm in expected.items():
        assert abs(norms[name] - norm) <= floor + 1e-9 * norm, name
    if mode == "train":
        for name, value in flat(changed).items():
            theirs = golden[f"train/after_one_forward/{torch_name(f'masknet/{name}')}"]
            assert_near(value, theirs, part)


@released
def test_the_first_steps_are_the_authors(golden, x64):
    trainable, stats = split_batch_stats(filled(golden))
    optimizer = optax.adam(1e-4)
    state = optimizer.init(trainable)

    @jax.jit
    def step(trainable, stats, state):
        (loss, (_, stats)), gradient = jax.value_and_grad(mean_squares, has_aux=True)(
            trainable, stats, golden, "train"
        )
        updates, state = optimizer.update(gradient, state, trainable)
        return loss, optax.apply_updates(trainable, updates), stats, state

    losses = []
    for _ in golden["train/loss_trajectory"]:
        loss, trainable, stats, state = step(trainable, stats, state)
        losses.append(float(loss))
    assert_near(np.array(losses), golden["train/loss_trajectory"], TRAIN)


def flat(tree) -> dict:
    """Leaves by their names."""
    return flatten_dict(tree, sep="/")


def small_params(dtype=np.float32):
    rng = np.random.default_rng(0)
    arrays = {
        name: rng.uniform(0.5, 1.5, shape) if name.endswith("variance") else rng.normal(size=shape)
        for name, shape in shapes(SMALL).items()
    }
    return unflatten({name: x.astype(dtype) for name, x in arrays.items()}, SMALL)


def test_either_cloud_is_masked_and_padding_never_matters():
    params = small_params()
    source, target = random_cloud(1, 12).astype("f4"), random_cloud(2, 9).astype("f4")
    plain = predict(params, *(Cloud(x, np.int32(len(x))) for x in (source, target)))
    assert plain.motion is None
    longer = [np.concatenate([x, np.full((7, 3), np.nan, "f4")]) for x in (source, target)]
    padded = predict(params, *(Cloud(x, np.int32(len(x) - 7)) for x in longer))
    swapped = predict(params, *(Cloud(x, np.int32(len(x))) for x in (target, source)))
    tight = Tolerance(0.0, 1e-5)
    for name in ("source_overlap", "target_overlap"):
        found = np.asarray(getattr(padded, name))
        assert_close(found[:-7], getattr(plain, name), tight)
        assert not found[-7:].any()
    assert_close(swapped.source_overlap, plain.target_overlap, tight)


def test_the_shapes_are_those_of_the_network():
    clouds = jnp.zeros((2, 8, 3)), jnp.zeros((2, 9, 3))
    made = jax.eval_shape(
        lambda key: MaskNet(SMALL).init(key, *clouds, training=True), jax.random.key(0)
    )
    tree = {"masknet": join_batch_stats(made["params"], made["batch_stats"])}
    assert {name: x.shape for name, x in flat(tree).items()} == shapes(SMALL)


def test_layers_of_nothing_are_refused():
    with pytest.raises(ValueError, match=r"head must hold .* got \(\). Use \(1024, 512"):
        MaskNetConfig(head=())
