"""Every learned method beside DBDNet, small enough for a test."""

from dbdnet_jax.networks.dcp.network import DCPConfig
from dbdnet_jax.networks.finet.network import FINetConfig
from dbdnet_jax.networks.inenet.network import INENetConfig
from dbdnet_jax.networks.masknet.network import MaskNetConfig
from dbdnet_jax.networks.omnet.network import OMNetConfig
from dbdnet_jax.networks.rienet.network import RIENetConfig

SIZE = 40  # rows of a cloud, and INENet's channels
CONFIGS = {
    "dcp": DCPConfig(neighbours=6, edges=(8, 8), features=16, heads=2, hidden=16),
    "dcp_identity": DCPConfig(pointer="identity", neighbours=6, edges=(8, 8), features=16),
    "rienet": RIENetConfig(turns=2, edges=(8, 8), features=16, width=4),
    "omnet": OMNetConfig(
        turns=3, encoder=(8, 8, 16), fusion=(16, 8), decoder=(8, 8), regression=(16, 8)
    ),
    "finet": FINetConfig(
        turns=2, encoder=(8, 8, 16), exchanges=(1, 2), fusion=(16, 8), regression=(16, 8)
    ),
    "masknet": MaskNetConfig(encoder=(8, 16), head=(16, 8)),
    "inenet": INENetConfig(
        points=SIZE,
        transform=(8, 16),
        transform_head=(8,),
        encoder=(8, 8, 8, 16),
        features=16,
        mask=(16, 8),
        threshold=(8,),
    ),
}
