"""The paper's tables, whole: trained and scored here, or scored from weights that there are.

    python -m benchmarks.paper                              # all methods on the embedded shapes
    python -m benchmarks.paper --methods=dcp,dgcnn --seeds=1 --runs=runs/paper
    python -m benchmarks.paper --points=pairs               # the minutes another time
    python -m benchmarks.paper --categories=seen            # for the pairs of unseen categories
    python -m benchmarks.paper --noscore                    # train only; --notrain: score only
    python -m benchmarks.paper --config=configs/modelnet.py --config.data.folder=PATH
    python -m benchmarks.paper --public=FOLDER              # .t7 files of DCP and RIENet

On the embedded shapes each method is trained for the same pairs and then on to the same minutes of
one core, one after another, in RUNS/NAME; what is there is not done again, so a call that was
stopped is given again. Scores stand in benchmarks/results/paper_cad/NAME.json, and the tables are
of those files, whichever methods are asked for. Methods without weights are scored too.

With a configuration the weights are RUNS/NAME/params.npz, those trained on a half of the categories
(--config.data.categories=seen) RUNS/NAME_seen/params.npz; NAME is a method's here, `dual_branches`
DBDNet's. Tables are empty where nothing was trained. One core does all.
"""

import os
from pathlib import Path

import jax
from absl import app, flags, logging
from ml_collections import config_flags

from benchmarks.paper import of_data, public, tables
from benchmarks.paper.recipes import RECIPES, trainings
from benchmarks.paper.scoring import RESULTS, SETS, first, frozen_set, score_classical, score_runs
from benchmarks.paper.training import POINTS, train
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.training.config import read_config

CONFIG = config_flags.DEFINE_config_file("config", None, "A data set; else the embedded shapes.")
METHODS = flags.DEFINE_list("methods", list(RECIPES), "Which learned methods.")
PAIRS = flags.DEFINE_integer("pairs", 1600, "Pairs that each method is trained on.", lower_bound=1)
MINUTES = flags.DEFINE_float("minutes", 30.0, "Minutes of one core for each method.", lower_bound=0)
TRAINED = flags.DEFINE_multi_enum("points", POINTS, POINTS, "Train for the pairs, or the minutes.")
CATEGORIES = flags.DEFINE_multi_enum(
    "categories", ["all", "seen"], ["all", "seen"], "Train on all, or on the half that is seen."
)
SEEDS = flags.DEFINE_integer("seeds", 3, "Seeds of each step of the ladder.", lower_bound=1)
RUNS = flags.DEFINE_string("runs", "runs/paper", "Where the runs lie.")
TRAIN = flags.DEFINE_bool("train", True, "Train what is not trained yet.")
SCORE = flags.DEFINE_bool("score", True, "Score what is not scored yet.")
COUNT = flags.DEFINE_integer("count", None, "Only the first pairs of every set.", lower_bound=1)
RESULTS_DIR = flags.DEFINE_string("results", str(RESULTS), "Where the scores stand.")
PUBLIC = flags.DEFINE_string("public", None, "A folder of public weights to score instead.")


def main(argv: list[str]) -> None:
    """Train, score and print."""
    logging.set_verbosity(logging.WARNING)
    unknown = [name for name in METHODS.value if name not in RECIPES]
    if unknown:
        raise app.UsageError(f"--methods must be among {', '.join(RECIPES)}; got {unknown}.")
    if hasattr(os, "sched_setaffinity"):  # of this process and of those it starts
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    jax.config.update("jax_num_cpu_devices", 1)
    keep_compiled_programs()
    runs = Path(RUNS.value)
    try:
        if CONFIG.value is not None:
            config = read_config(CONFIG.value)
            print(of_data.tables(config, METHODS.value, runs, COUNT.value))
            return
        sets = {key: first(frozen_set(key), COUNT.value) for key in SETS}
        if PUBLIC.value:
            print(public.tables(Path(PUBLIC.value), {key: sets[key] for key in public.SETS}))
            return
        for name in METHODS.value:
            for categories in CATEGORIES.value if TRAIN.value else ():
                for training in trainings(RECIPES[name], SEEDS.value, categories == "seen"):
                    train(
                        RECIPES[name],
                        training,
                        training.folder(runs, name),
                        pairs=PAIRS.value,
                        minutes=MINUTES.value,
                        points=TRAINED.value,
                    )
            if SCORE.value:
                score_runs([name], runs, SEEDS.value, sets, Path(RESULTS_DIR.value))
        if SCORE.value:
            score_classical(sets, Path(RESULTS_DIR.value))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
    print(tables.of_results(Path(RESULTS_DIR.value)))


if __name__ == "__main__":
    app.run(main)
