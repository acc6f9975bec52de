"""Put trained weights into the package, with what they are and what they score.

    python -m tools.ship_weights runs/cad --pairs 32100 32100
    python -m tools.ship_weights runs/overlap runs/registration --pairs 104576 39260

Takes the overlap network of the first run, and the registration network and the configuration of
the last (those of the joint stage where it has run; its pairs count for both networks), scores them
on the validation pairs and on the frozen test pairs of configs/cad.py, and writes
dbdnet_jax/networks/pretrained/NAME.npz. Fit the success probability anew afterwards:
`python -m tools.fit_success`.
"""

import argparse
import dataclasses
import json
import subprocess
from pathlib import Path

import jax

from configs import cad
from dbdnet_jax.data.frozen import CAD_VARIANTS, cad_test_pairs
from dbdnet_jax.data.training_pairs import load_training_pairs
from dbdnet_jax.evaluation.methods import Method, from_network
from dbdnet_jax.evaluation.run import evaluate_method
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import PRETRAINED, load_params, save_params
from dbdnet_jax.training.config import read_config
from dbdnet_jax.training.run_folder import load_best
from dbdnet_jax.types import Pair


def main() -> None:
    """Read the arguments, merge, score and write."""
    parser = argparse.ArgumentParser("ship_weights")
    parser.add_argument("runs", nargs="+", type=Path, help="run folders or .npz files: one or two")
    parser.add_argument("--name", default="cad")
    parser.add_argument("--pairs", nargs=2, type=int, required=True, help="seen by each network")
    parser.add_argument("--note", default="", help="anything else that people should know")
    options = parser.parse_args()
    if len(options.runs) > 2:
        parser.error(f"give one or two runs; got {len(options.runs)}")
    overlap, registration = (_load(path) for path in (options.runs[0], options.runs[-1]))
    config = read_config(cad.get_config())
    networks = {"overlap": overlap.overlap, "registration": registration.registration}
    params = Params(networks, registration.config)
    training = load_training_pairs(
        config.data,
        config.protocol,
        seed=config.train.seed,
        validation_pairs=config.train.validation_pairs,
        batch_size=1,
    )
    metadata = {
        "protocol": dataclasses.asdict(config.protocol),
        "pairs_seen": dict(zip(networks, options.pairs, strict=True)),
        "note": options.note,
        "shipped_from": subprocess.check_output(["git", "rev-parse", "HEAD"], text=True).strip(),
        "validation": _figures(params, jax.device_get(training.validation)),
        "test": {
            variant: {"sha256": digest, **_figures(params, pairs)}
            for variant in CAD_VARIANTS
            if variant != "unseen"
            for pairs, digest in [cad_test_pairs(variant)]
        },
    }
    save_params(PRETRAINED / f"{options.name}.npz", params, metadata=metadata)
    print(json.dumps(metadata, indent=2))


def _load(path: Path) -> Params:
    return load_params(path) if path.suffix == ".npz" else load_best(path)


def _figures(params: Params, pairs: Pair) -> dict:
    """The network's row over stacked pairs, without the time."""
    row = evaluate_method(Method("DBDNet", from_network(params)), pairs)
    assert row.summary is not None and row.overlap is not None
    overlap = {f"overlap_{name}": round(x, 4) for name, x in row.overlap._asdict().items()}
    motion = {name: round(x, 4) for name, x in row.summary._asdict().items()}
    return motion | overlap


if __name__ == "__main__":
    main()
