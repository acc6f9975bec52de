"""How `train.py` and `evaluate.py` start: their devices, and the processes they work with."""

import jax
from absl import flags

from dbdnet_jax.io.programs import keep_compiled_programs, require_device
from dbdnet_jax.io.workers import available_cores
from dbdnet_jax.training.parallel import join_processes

DISTRIBUTED = flags.DEFINE_bool(
    "distributed", False, "One of several processes that work together; see docs/scaling.md."
)
COORDINATOR = flags.DEFINE_string("coordinator", None, "HOST:PORT of process 0 of several.")
PROCESSES = flags.DEFINE_integer("processes", None, "How many work together.", lower_bound=1)
PROCESS_ID = flags.DEFINE_integer("process_id", None, "Which of them this is, from 0.")


def start(devices: int, pairs: int) -> None:
    """Decide on the devices before anything asks JAX for one: their number is fixed from then on.

    A CPU gets ``devices`` of XLA's, this process's part of them; where it is 0, one for each core
    that the process may use. More than ``pairs``, those that are worked on at a time, would have
    nothing to do.

    Raises:
        ValueError: no way to the other processes is given, they cannot be reached, or there is no
            device.
    """
    together = DISTRIBUTED.value or COORDINATOR.value
    if not together and (PROCESSES.value, PROCESS_ID.value) != (None, None):
        raise ValueError(
            "--processes and --process_id must come with --coordinator=HOST:PORT or --distributed, "
            f"or this process works alone; got --processes={PROCESSES.value}, --process_id="
            f"{PROCESS_ID.value}. Add one of the two, or leave them out."
        )
    own = devices // (PROCESSES.value or 1) or min(len(available_cores()), pairs)
    jax.config.update("jax_num_cpu_devices", own)
    if together:
        join_processes(COORDINATOR.value, PROCESSES.value, PROCESS_ID.value)
    keep_compiled_programs()
    require_device()
