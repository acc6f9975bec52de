"""The stages of every learned method: one line each."""

from dbdnet_jax.training import (
    dbdnet,
    dbdnet_tasks,
    dcp,
    finet,
    inenet,
    masknet,
    omnet,
    rienet,
)
from dbdnet_jax.training.task import Stage

STAGES = {
    "dbdnet": {
        "overlap": Stage(dbdnet.OverlapConfig, dbdnet_tasks.overlap_task),
        "registration": Stage(dbdnet.RegistrationConfig, dbdnet_tasks.registration_task),
        "joint": Stage(dbdnet.JointConfig, dbdnet_tasks.joint_task, ("overlap", "registration")),
    },
    "masknet": {"masknet": Stage(masknet.MaskNetStage, masknet.masknet_task)},
    "dcp": {"dcp": Stage(dcp.DCPStage, dcp.dcp_task)},
    "rienet": {"rienet": Stage(rienet.RIENetStage, rienet.rienet_task)},
    "omnet": {"omnet": Stage(omnet.OMNetStage, omnet.omnet_task)},
    "finet": {"finet": Stage(finet.FINetStage, finet.finet_task)},
    "inenet": {"inenet": Stage(inenet.INENetStage, inenet.inenet_task)},
}
