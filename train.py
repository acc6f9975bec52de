"""Train a learned method: for DBDNet the overlap network, then the registration network behind it.

    python train.py --config=configs/cad_short.py
    python train.py --config=configs/cad.py --config.train.batch_size=4 --run_dir=runs/mine
    python train.py --config=configs/cad.py --stage=joint  # goes on from runs/cad

A run that was stopped goes on when the same command is given again; SIGTERM, SIGHUP and Ctrl-C save
its state first and end it with status 0. The best weights end up in
RUN_DIR/params.npz, the curves in RUN_DIR/STAGE/*.csv and, for TensorBoard, beside them.
"""

import shlex
import sys
from pathlib import Path

import jax
from absl import app, flags, logging
from ml_collections import config_flags

from dbdnet_jax.data.test_pairs import load_test_pairs
from dbdnet_jax.data.training_pairs import load_training_pairs
from dbdnet_jax.evaluation.methods import Weights
from dbdnet_jax.evaluation.run import evaluate
from dbdnet_jax.evaluation.tables import render, save
from dbdnet_jax.networks.table import parts_of
from dbdnet_jax.networks.weights import save_params
from dbdnet_jax.training import launch
from dbdnet_jax.training.config import parse_flags, read_config
from dbdnet_jax.training.loop import fit
from dbdnet_jax.training.preemption import Interrupted, Preempted, interrupt_on_signals
from dbdnet_jax.training.run_folder import load_best
from dbdnet_jax.training.start import describe_start
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
RUN_DIR = flags.DEFINE_string("run_dir", None, "Where results go; runs/NAME if not given.")
STAGE = flags.DEFINE_string(
    "stage", "all", "What to train: a stage, or one for each network there is (all, or both)."
)
EVALUATE = flags.DEFINE_bool("evaluate", True, "Print the table of results at the end.")


def stages_of(config: RunConfig, stage: str) -> tuple[str, ...]:
    """The stages that ``--stage`` asks for; all of them are those of the networks there are."""
    method, known = config.method, STAGES[config.method]
    if stage in ("all", "both"):
        return parts_of(config.model)
    if stage not in known:
        raise ValueError(
            f"--stage must be all, both or one of {', '.join(known)} for the method {method}; got "
            f"{stage!r}. Choose one."
        )
    return (stage,)


def main(argv: list[str]) -> None:
    """Train the stages asked for, export the best weights, and score them."""
    if argv[1:]:
        raise app.UsageError(f"arguments must be flags such as --stage=both; got {argv[1:]}.")
    logging.set_verbosity(logging.WARNING)  # Orbax tells a page about every checkpoint
    config_file = config_flags.get_config_filename(flags.FLAGS["config"])
    run_dir = Path(RUN_DIR.value or Path("runs") / Path(config_file).stem)
    try:
        with interrupt_on_signals():
            train(run_dir)
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")
    except Preempted as stopped:
        print(f"{stopped} The same command goes on from there.")
    except Interrupted:
        print("Stopped. The same command goes on from the last checkpoint.")


def train(run_dir: Path) -> None:
    """`main` between its flags and its errors."""
    config = read_config(CONFIG.value)
    stages = stages_of(config, STAGE.value)
    most = max(stage.batch_size for stage in config.stages.values())
    launch.start(config.train.devices, most)
    first = jax.process_index() == 0
    if config.train.start and first:
        print(describe_start(config))
    for stage in stages:
        stream = load_training_pairs(
            config.data,
            config.protocol,
            seed=config.train.seed,
            validation_pairs=config.train.validation_pairs,
            batch_size=config.stages[stage].batch_size,
        )
        fit(config, stage, run_dir, stream)
    params = load_best(run_dir)
    if first:
        save_params(run_dir / "params.npz", params)
        print(f"The best weights are in {run_dir / 'params.npz'}.")
    if EVALUATE.value and set(parts_of(config.model)) <= params.networks.keys():
        evaluation = evaluate(
            [Weights("params", params)],
            load_test_pairs(config.data, config.protocol, run_dir),
            seed=config.train.seed,
            command=shlex.join(["python", *sys.argv]),
            devices=config.train.devices,
        )
        if first:
            print(render(evaluation))
            save(evaluation, run_dir)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
