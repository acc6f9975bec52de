"""Score DBDNet beside ICP and FGR on frozen test pairs, and print the paper's table.

    python evaluate.py --config=configs/cad.py                     # what train.py left in runs/cad
    python evaluate.py --config=configs/cad.py --params=cad        # the weights in the package
    python evaluate.py --config=configs/cad.py --params=mine.npz

The configuration's data set and protocol decide the pairs: --config.protocol.noise_sigma=0.0
scores without noise, --config.protocol.disjoint=True without common points. Scans, of which
--benchmark=3DLoMatch takes those of little overlap, have a table of registration recall too. All is
also written to RUN_DIR/evaluation_SET.csv and .json.
"""

import shlex
import sys
from pathlib import Path

from absl import app, flags, logging
from ml_collections import config_flags

from dbdnet_jax.checkpoint import load_best
from dbdnet_jax.evaluation import evaluate
from dbdnet_jax.model.params import Params
from dbdnet_jax.programs import keep_compiled_programs
from dbdnet_jax.report import render, save
from dbdnet_jax.settings import parse_flags, read_settings
from dbdnet_jax.weights import load_params, load_pretrained

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
RUN_DIR = flags.DEFINE_string("run_dir", None, "The run to score; runs/NAME if not given.")
PARAMS = flags.DEFINE_string("params", None, "Weights: a .npz file or a name; else the run's best.")
BENCHMARK = flags.DEFINE_enum("benchmark", "3DMatch", ["3DMatch", "3DLoMatch"], "For scans.")
COUNT = flags.DEFINE_integer("count", None, "Only the first pairs.", lower_bound=1)


def choose_params(params: str | None, run_dir: Path) -> Params:
    """The weights asked for: a file, a name of weights in the package, or the run's best."""
    if params is None:
        return load_best(run_dir)
    return load_params(params) if params.endswith(".npz") else load_pretrained(params)


def main(argv: list[str]) -> None:
    """Choose the weights, score them, print and write the table."""
    if argv[1:]:
        raise app.UsageError(f"arguments must be flags such as --params=cad; got {argv[1:]}.")
    logging.set_verbosity(logging.WARNING)
    keep_compiled_programs()
    config_file = config_flags.get_config_filename(flags.FLAGS["config"])
    run_dir = Path(RUN_DIR.value or Path("runs") / Path(config_file).stem)
    try:
        evaluation = evaluate(
            read_settings(CONFIG.value),
            choose_params(PARAMS.value, run_dir),
            run_dir,
            command=shlex.join(["python", *sys.argv]),
            benchmark=BENCHMARK.value,
            count=COUNT.value,
        )
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    print(render(evaluation))
    save(evaluation, run_dir)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
