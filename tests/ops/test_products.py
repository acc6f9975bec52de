"""Products in bfloat16: rounded factors, sums and all else in float32."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from ml_dtypes import bfloat16

from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import bfloat16_kernels
from dbdnet_jax.ops.attention import attention
from dbdnet_jax.ops.products import product
from tests.conftest import EXACT, FLOAT32, assert_close, random_cloud
from tests.networks.dbdnet.small import SMALL


def rounded(x):
    return np.float64(np.asarray(x, bfloat16))


def test_products_of_the_type_of_the_features_are_the_plain_ones(precision):
    a, b = (jnp.asarray(random_cloud(i, 6, 6), precision.dtype) for i in (0, 1))
    assert_close(product(a, b), jnp.matmul(a, b), EXACT)


@pytest.mark.parametrize("rows", [(7,), (3, 7)])
def test_a_product_rounds_its_factors_but_not_its_sums_in_the_derivative_too(rows):
    a = np.float32(random_cloud(0, 21, 30)[: np.prod(rows)].reshape(*rows, 30))
    b, along = np.float32(random_cloud(1, 30, 5)), np.float32(random_cloud(2, 21, 5))
    along = along[: np.prod(rows)].reshape(*rows, 5)

    def value(a, b):
        return product(a, b.astype(jnp.bfloat16))

    found, pull = jax.vjp(value, jnp.asarray(a), jnp.asarray(b))
    of_a, of_b = pull(jnp.asarray(along))
    assert found.dtype == of_a.dtype == of_b.dtype == np.float32
    a, b, along = rounded(a), rounded(b), rounded(along)
    assert_close(found, a @ b, FLOAT32)
    assert_close(of_a, along @ b.T, FLOAT32)
    expected = np.tensordot(a, along, (range(len(rows)), range(len(rows))))
    assert_close(rounded(of_b), rounded(np.float32(expected)), EXACT)


def test_attention_rounds_its_products_alone():
    query, key, value = (jnp.asarray(random_cloud(i, 9, 8), jnp.float32) for i in range(3))
    valid = jnp.arange(9) < 7
    low = key.astype(jnp.bfloat16), value.astype(jnp.bfloat16)
    found = attention(query, *low, valid, 2)
    assert found.dtype == np.float32
    difference = np.abs(found - attention(query, key, value, valid, 2)).max()
    assert 1e-5 < difference < 2e-2


def products_of(jaxpr):
    """The matrix products of a traced program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from products_of(inner)


def network(encoder: str):
    """A small one, the same with rounded kernels, and two clouds."""
    config = dataclasses.replace(SMALL, encoder=encoder)
    params = init_params(jax.random.key(5), config)
    low = params.replace(networks=bfloat16_kernels(params.networks))
    return params, low, [jnp.asarray(random_cloud(i, 40), jnp.float32) for i in (0, 1)]


@pytest.mark.parametrize(("encoder", "at_least"), [("multiresolution", 50), ("dgcnn", 20)])
def test_a_network_of_rounded_kernels_keeps_geometry_and_coordinates_in_float32(encoder, at_least):
    _, low, clouds = network(encoder)
    products = list(products_of(jax.make_jaxpr(register)(low, *clouds).jaxpr))
    half = [e for e in products if e.invars[0].aval.dtype == jnp.bfloat16]
    assert len(half) > at_least  # of these networks' layers and attentions
    assert all(e.outvars[0].aval.dtype == np.float32 for e in half)
    exact = [e for e in products if e.params["precision"] and e not in half]
    assert len(exact) > 10 and not any(e.params["precision"] for e in half)
    # Points, and points with the number of their cloud.
    layers = {e.invars[1].aval.shape for e in half}
    assert not any(shape[0] == 3 for shape in layers) and (4, 64) not in layers


def test_rounded_kernels_change_answers_a_little():
    params, low, clouds = network("dgcnn")
    found, expected = (jax.jit(register)(x, *clouds) for x in (low, params))
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} <= {np.dtype("float32"), np.dtype(bool)}
    difference = np.abs(found.src_overlap - expected.src_overlap).max()
    assert 1e-5 < difference < 0.1
