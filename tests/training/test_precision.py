"""A step whose products are in bfloat16 moves weights of float32 by a gradient of float32."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from dbdnet_jax.ops.products import product
from dbdnet_jax.training.parallel import training_mesh
from dbdnet_jax.training.step import init_state, train_step
from tests import stand_in


def test_the_loss_sees_rounded_kernels_and_the_state_holds_exact_ones():
    seen, frozen = [], {"layer": {"kernel": jnp.eye(3), "bias": jnp.ones(3)}}

    def loss(trainable, frozen, pair, key):
        seen.append([jax.tree.map(lambda leaf: leaf.dtype.name, x) for x in (trainable, frozen)])
        fit = jnp.mean(product(pair.target.points, trainable["kernel"]) ** 2)
        return fit, stand_in.Terms(fit, fit)

    pairs, optimizer, mesh = stand_in.source(), optax.sgd(1e-3), training_mesh(4)
    trainable = {"kernel": jnp.full((3, 3), 0.1), "offset": jnp.ones(3)}
    state = init_state(trainable, optimizer, ema_decay=0.9)
    found = {}
    for precision in ("float32", "bfloat16"):
        found[precision], metrics = train_step(
            state,
            frozen,
            jax.random.key(0),
            next(pairs.arrays(0)),
            draw=pairs.draw,
            loss=loss,
            optimizer=optimizer,
            batch_size=4,
            mesh=mesh,
            ema_decay=0.9,
            precision=precision,
        )
        assert metrics.finite
    kernels = [(x[0]["kernel"], x[1]["layer"]["kernel"]) for x in seen]
    assert set(kernels) == {("float32", "float32"), ("bfloat16", "bfloat16")}
    assert all(x[0]["offset"] == x[1]["layer"]["bias"] == "float32" for x in seen)
    exact, low = (found[precision].params["kernel"] for precision in ("float32", "bfloat16"))
    assert low.dtype == found["bfloat16"].ema["kernel"].dtype == np.float32
    assert (low != exact).any() and (low.astype(jnp.bfloat16).astype(jnp.float32) != low).any()
    np.testing.assert_allclose(low - 0.1, exact - 0.1, rtol=0.02)
