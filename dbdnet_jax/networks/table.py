"""The learned methods: one line each."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from dbdnet_jax.networks.dbdnet import method as dbdnet
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.released import from_released
from dbdnet_jax.networks.dcp import network as dcp
from dbdnet_jax.networks.dcp.released import from_released as dcp_from_released
from dbdnet_jax.networks.finet import network as finet
from dbdnet_jax.networks.inenet import network as inenet
from dbdnet_jax.networks.masknet import network as masknet
from dbdnet_jax.networks.omnet import network as omnet
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.rienet import network as rienet
from dbdnet_jax.networks.rienet.released import from_released as rienet_from_released
from dbdnet_jax.types import Answer


class Learned(NamedTuple):
    """All that the rest of the house needs to know of a method.

    ``config`` is a frozen dataclass, with a default for every field; it travels with the weights,
    and its type tells the method. ``parts`` are the networks that there may be (`parts_of`: those
    of a configuration); the names in ``shapes(config)`` begin with them. ``initial(config)`` gives
    those parameters that start neither from random numbers nor as a norm does.
    ``predict_given_overlap`` is for params without their first part: it is told the overlap of both
    clouds.
    """

    title: str  # in tables
    config: type
    shapes: Callable[[Any], Shapes]
    parts: tuple[str, ...]
    predict: Callable[..., Answer]  # (params, source: Cloud, target: Cloud)
    from_released: Callable[..., Params] | None = None
    initial: Callable[[Any], dict[str, Any]] | None = None
    predict_given_overlap: Callable[..., Answer] | None = None


DEFAULT_METHOD = "dbdnet"  # of files and configurations that name none
LEARNED = {
    "dbdnet": Learned(
        "DBDNet",
        ModelConfig,
        dbdnet.shapes,
        ("overlap", "registration"),
        dbdnet.predict,
        from_released,
        dbdnet.initial,
        dbdnet.predict_given_overlap,
    ),
    "masknet": Learned(
        "MaskNet", masknet.MaskNetConfig, masknet.shapes, ("masknet",), masknet.predict
    ),
    "dcp": Learned("DCP", dcp.DCPConfig, dcp.shapes, ("dcp",), dcp.predict, dcp_from_released),
    "rienet": Learned(
        "RIENet",
        rienet.RIENetConfig,
        rienet.shapes,
        ("rienet",),
        rienet.predict,
        rienet_from_released,
    ),
    "omnet": Learned("OMNet", omnet.OMNetConfig, omnet.shapes, ("omnet",), omnet.predict),
    "finet": Learned("FINet", finet.FINetConfig, finet.shapes, ("finet",), finet.predict),
    "inenet": Learned("INENet", inenet.INENetConfig, inenet.shapes, ("inenet",), inenet.predict),
}


def method_of(config: Any) -> str:
    """The name of the method that a configuration is of."""
    return next(name for name, method in LEARNED.items() if method.config is type(config))


def learned(config: Any) -> Learned:
    """The method that a configuration is of."""
    return LEARNED[method_of(config)]


def parts_of(config: Any) -> tuple[str, ...]:
    """The networks that a configuration has."""
    method = learned(config)
    found = {name.split("/")[0] for name in method.shapes(config)}
    return tuple(part for part in method.parts if part in found)


def parameter_shapes(config: Any, parts: Collection[str] | None = None) -> Shapes:
    """Shape of every parameter by its name in the tree; of these parts only, if given."""
    shapes = learned(config).shapes(config)
    return {
        name: shape
        for name, shape in shapes.items()
        if parts is None or name.split("/")[0] in parts
    }
