"""Score learned methods beside ICP and FGR on frozen test pairs, and print the paper's table.

    python evaluate.py --config=configs/cad.py                     # what train.py left in runs/cad
    python evaluate.py --config=configs/cad.py --params=cad        # the weights in the package
    python evaluate.py --config=configs/cad.py --params=mine.npz --params=cad  # a row for each
    python evaluate.py --config=configs/cad.py --params=cad --sweep=crop

The configuration's data set and protocol decide the pairs: --config.protocol.noise_sigma=0.0
scores without noise, --config.protocol.disjoint=True without common points. Scans, of which
--benchmark=3DLoMatch takes those of little overlap, have a table of registration recall too. The
networks' pairs are shared by all devices, or by --config.train.devices of them, and all pairs by
processes as in training; --config.train.precision=bfloat16 is for the networks' products. All is
also written to RUN_DIR/evaluation_SET.csv and .json, and with --report drawn on a page beside them.
"""

import dataclasses
import shlex
import sys
from pathlib import Path

import jax
from absl import app, flags, logging
from ml_collections import config_flags

from dbdnet_jax.data.test_pairs import BENCHMARKS, load_test_pairs
from dbdnet_jax.drawing.evaluation_page import evaluation_page
from dbdnet_jax.errors import MissingExtraError, require_drawing
from dbdnet_jax.evaluation.methods import Weights, load_weights
from dbdnet_jax.evaluation.run import evaluate
from dbdnet_jax.evaluation.sweep import SWEEP_PAIRS, SWEEPS, render_sweep, save_sweep, sweep
from dbdnet_jax.evaluation.tables import render, save
from dbdnet_jax.io.files import require_writable, write_atomic
from dbdnet_jax.networks.params import Params, bfloat16_kernels
from dbdnet_jax.networks.table import DEFAULT_METHOD, method_of
from dbdnet_jax.networks.weights import PRETRAINED, load_named
from dbdnet_jax.training import launch
from dbdnet_jax.training.config import parse_flags, read_config
from dbdnet_jax.training.run_folder import load_best, was_trained
from dbdnet_jax.training.task import RunConfig

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
RUN_DIR = flags.DEFINE_string("run_dir", None, "The run to score; runs/NAME if not given.")
PARAMS = flags.DEFINE_multi_string(
    "params", None, "Weights: a .npz file or a name; else the run's best. May be given repeatedly."
)
BENCHMARK = flags.DEFINE_enum("benchmark", BENCHMARKS[0], BENCHMARKS, "For scans.")
COUNT = flags.DEFINE_integer("count", None, "Only the first pairs.", lower_bound=1)
SWEEP = flags.DEFINE_multi_enum(
    "sweep", None, list(SWEEPS), "Vary this part of the protocol instead; may be given repeatedly."
)
MANY = 1 << 16  # pairs: more than a CPU's cores
REPORT = flags.DEFINE_bool("report", False, "Draw a page too, with the sweeps saved in RUN_DIR.")


def choose_weights(
    params: list[str] | None, run_dir: str | None, config_name: str
) -> list[Weights]:
    """The weights asked for: files, or names of weights in the package, or a run's best.

    Without any of them the best of runs/NAME or, where nothing was trained, the package's for the
    configuration of that name.
    """
    if params:
        return load_weights(params)
    default = Path("runs") / config_name
    packaged = (PRETRAINED / f"{config_name}.npz").is_file()
    if run_dir is not None or was_trained(default) or not packaged:
        return [Weights("best", load_best(run_dir or default))]
    print(f"{default} holds no training; scoring the weights in the package.", file=sys.stderr)
    return [Weights(config_name, load_named(config_name))]


def _rounded(label: str, params: Params) -> Weights:
    """Weights whose products are in bfloat16."""
    method = method_of(params.config)
    if method != DEFAULT_METHOD:
        raise ValueError(
            f"config.train.precision must be 'float32' for weights of another method than "
            f"{DEFAULT_METHOD}; got 'bfloat16' for {label} of {method}. Score them apart."
        )
    return Weights(label, dataclasses.replace(params, networks=bfloat16_kernels(params.networks)))


def run_sweeps(config: RunConfig, weights: list[Weights], run_dir: Path) -> None:
    """Print and write one table for each sweep asked for."""
    for name in SWEEP.value or ():
        points = list(
            sweep(
                name,
                config.data,
                config.protocol,
                weights,
                run_dir,
                seed=config.train.seed,
                count=COUNT.value or SWEEP_PAIRS,
                devices=config.train.devices,
            )
        )
        if jax.process_index():
            continue  # the first process prints and writes
        command = shlex.join(["python", *sys.argv])
        print(render_sweep(name, points, command), end="\n\n")
        save_sweep(name, points, run_dir, command)


def main(argv: list[str]) -> None:
    """Choose the weights, score them, print and write the table."""
    if argv[1:]:
        raise app.UsageError(f"arguments must be flags such as --params=cad; got {argv[1:]}.")
    if SWEEP.value and (REPORT.value or BENCHMARK.value != BENCHMARKS[0]):
        raise app.UsageError(
            "--sweep goes without --report and --benchmark; a later call with --report alone draws "
            "the sweeps that were saved."
        )
    logging.set_verbosity(logging.WARNING)
    config_name = Path(config_flags.get_config_filename(flags.FLAGS["config"])).stem
    run_dir = Path(RUN_DIR.value or Path("runs") / config_name)
    try:
        require_writable(run_dir)
        if REPORT.value:
            require_drawing()
        config = read_config(CONFIG.value)
        launch.start(config.train.devices, COUNT.value or MANY)
        weights = choose_weights(PARAMS.value, RUN_DIR.value, config_name)
        if config.train.precision == "bfloat16":
            weights = [_rounded(*entry) for entry in weights]
        if SWEEP.value:
            return run_sweeps(config, weights, run_dir)
        evaluation = evaluate(
            weights,
            load_test_pairs(config.data, config.protocol, run_dir, BENCHMARK.value),
            seed=config.train.seed,
            command=shlex.join(["python", *sys.argv]),
            count=COUNT.value,
            devices=config.train.devices,
        )
        if jax.process_index():
            return
        print(render(evaluation))
        save(evaluation, run_dir)
        if REPORT.value:
            page = run_dir / f"evaluation_{evaluation.pair_set}.html"
            write_atomic(page, evaluation_page(evaluation, run_dir))
    except (ValueError, OSError, MissingExtraError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
