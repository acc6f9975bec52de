"""The stages of every learned method: one line each."""

from dbdnet_jax.training import dbdnet, dbdnet_tasks, masknet
from dbdnet_jax.training.task import Stage

STAGES = {
    "dbdnet": {
        "overlap": Stage(dbdnet.OverlapConfig, dbdnet_tasks.overlap_task),
        "registration": Stage(dbdnet.RegistrationConfig, dbdnet_tasks.registration_task),
        "joint": Stage(dbdnet.JointConfig, dbdnet_tasks.joint_task, ("overlap", "registration")),
    },
    "masknet": {"masknet": Stage(masknet.MaskNetStage, masknet.masknet_task)},
}
