"""The registration network's two branches."""

import dataclasses

import jax
import numpy as np

from dbdnet_jax.networks.dbdnet.frames import stack_clouds
from dbdnet_jax.networks.dbdnet.registration import RegistrationNetwork
from tests.conftest import EXACT, assert_close, random_cloud
from tests.networks.dbdnet.small import SMALL, small_params, whole

NETWORK = RegistrationNetwork(dataclasses.replace(SMALL, dropout=0.5))


def test_each_branch_drops_attention_weights_of_its_own():
    tree = dict(small_params(dtype=np.float32).registration)
    for name in list(tree):  # both branches of the same weights
        if name.startswith("attention_R"):
            tree[name.replace("_R", "_t")] = tree[name]
    linear = tree["weight_net"]["linear"]
    same = {"kernel": 0 * linear["kernel"], "bias": linear["bias"].at[2:].set(linear["bias"][:2])}
    tree["weight_net"] = {**tree["weight_net"], "linear": same}
    clouds = stack_clouds(*(whole(random_cloud(s, 24).astype(np.float32)) for s in (1, 2)))
    features = jax.random.normal(jax.random.key(0), (2, 24, 16))
    match = jax.jit(
        lambda key: NETWORK.apply({"params": tree}, clouds, features, key, method="match").matrix
    )
    assert_close(*match(None), EXACT)
    of_rotation, of_translation = match(jax.random.key(1))
    assert np.abs(of_rotation - of_translation).max() > 1e-4
