"""The rows of a table: every method as a function on pairs, and what is to be known of it."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.alignment.align import align
from dbdnet_jax.classical.open3d import fgr, fgr_estimated, icp, icp_centred, identity
from dbdnet_jax.classical.refine import refine_multistart
from dbdnet_jax.networks.batch_norm import fold_params
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import learned, parts_of
from dbdnet_jax.networks.weights import PRETRAINED, load_named
from dbdnet_jax.types import Answer, Cloud, Pair, Rigid

Answering = Callable[[Pair], Answer]


class Traits(NamedTuple):
    """What sets a row apart from others; all False for a classical method on points alone."""

    learned: bool = False  # from weights
    untrained: bool = False  # from fresh ones
    given_overlap: bool = False  # told which points overlap: a bound
    refined: bool = False  # by lengths that are those of a shape in the unit sphere
    aligned: bool = False  # by `align`, as a user calls it
    needs_normals: bool = False
    moves: bool = True  # tries to register at all


@dataclasses.dataclass(frozen=True, eq=False)
class Network:
    """An answer that devices can share: pure, with its parameters apart."""

    predict: Callable[[Pair, Params], Answer]  # compiled once per shape and model configuration
    params: Params

    def __call__(self, pair: Pair) -> Answer:
        """Answer one pair."""
        return self.predict(pair, self.params)


class Method(NamedTuple):
    """One row of a table before it is scored."""

    name: str
    answer: Answering
    traits: Traits = Traits()


class Weights(NamedTuple):
    """Parameters of any method, and what to call them where its title does not tell."""

    label: str
    params: Params


def load_weights(names: Sequence[str]) -> list[Weights]:
    """Weights by the paths of files, or their names in the package, each with a label of its own.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: no such name; otherwise as `load_params`.
        ValueError: the same file twice.
    """
    labels = labels_of(names)
    return [Weights(*entry) for entry in zip(labels, map(load_named, names), strict=True)]


def labels_of(names: Sequence[str]) -> list[str]:
    """What tells weights apart: the shortest end of each path; a run's folder for its params.npz.

    Raises:
        ValueError: the same file twice.
    """
    paths: dict[Path, tuple[str, ...]] = {}
    for name in names:
        own = name.endswith(".npz")
        file = (Path(name) if own else PRETRAINED / f"{name}.npz").resolve()
        if file in paths:
            raise ValueError(
                f"weights must each be of another file; got {name} for {file}, which was given "
                "before. Leave one of the two out."
            )
        paths[file] = file.with_suffix("").parts if own else (name,)
    whole = list(paths.values())
    of_runs = [path[:-1] if path[-1] == "params" else path for path in whole]
    if len(set(of_runs)) == len(whole):
        whole = of_runs
    return [_shortest_end(path, [other for other in whole if other != path]) for path in whole]


def _shortest_end(path: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> str:
    """The last parts of a path, as many as it takes to be the end of none of the others."""
    counts = range(1, len(path))
    differing = (n for n in counts if all(path[-n:] != other[-n:] for other in others))
    return "/".join(path[-next(differing, len(path)) :])


def make_methods(weights: Sequence[Weights], seed: int) -> list[Method]:
    """The rows of the table; ``seed`` is that of the untrained weights.

    Raises:
        ValueError: params without the networks that their method needs.
    """
    methods = [
        Method("identity", from_points(identity), Traits(moves=False)),
        Method("ICP", from_points(icp)),
        Method("ICP, centroids first", from_points(icp_centred)),
        Method("FGR, true normals", from_normals(fgr), Traits(needs_normals=True)),
        Method("FGR, estimated normals", from_points(fgr_estimated)),
    ]
    titles = [learned(entry.params.config).title for entry in weights]
    for (label, params), title in zip(weights, titles, strict=True):
        ambiguous = titles.count(title) > 1
        name = f"{title} ({label})" if ambiguous else title
        methods += learned_methods(params, name, seed)
    return methods


def learned_methods(params: Params, name: str, seed: int) -> list[Method]:
    """The rows of one method's weights: untrained, as they are and, for DBDNet, beyond.

    Without an overlap network they are given the true overlap, and the name says so.
    """
    method = learned(params.config)
    parts = parts_of(params.config)
    missing = [part for part in parts if part not in params.networks]
    untrained = init_params(jax.random.key(seed), params.config)
    ask = from_network
    traits = Traits(learned=True)
    if missing and missing == [parts[0]] and method.predict_given_overlap is not None:
        ask, traits, name = (
            from_true_overlap,
            Traits(True, given_overlap=True),
            (f"{name}, true overlap given"),
        )
    elif missing:
        raise ValueError(
            f"an evaluation of {name} needs a {missing[-1]} network; these params hold only "
            f"{', '.join(params.networks) or 'none'}. Train it too: python train.py "
            f"--stage={missing[-1]}"
        )
    rows = [
        Method(f"{name} (untrained)", ask(untrained), traits._replace(untrained=True)),
        Method(name, ask(params), traits),
    ]
    if isinstance(params.config, ModelConfig) and not missing:
        refined = from_refined_network(params)
        rows.append(Method(f"{name}, refined", refined, traits._replace(refined=True)))
        rows.append(Method(f"align, {name}", from_align(params), traits._replace(aligned=True)))
    return rows


def possible(methods: Sequence[Method], *, normals: bool, unit_sphere: bool) -> list[Method]:
    """The methods that the pairs allow.

    Without ``normals``, as of scans, none that needs them; none whose refinement has the lengths of
    a shape in the ``unit_sphere`` where the clouds are none.
    """
    return [
        method
        for method in methods
        if (normals or not method.traits.needs_normals)
        and (unit_sphere or not method.traits.refined)
    ]


def from_points(baseline: Callable[..., Rigid]) -> Answering:
    """A baseline ``(source, target) -> Rigid`` as a method on pairs; padding is cut off."""
    return lambda pair: Answer(baseline(_points(pair.source), _points(pair.target)))


def from_normals(baseline: Callable[..., Rigid]) -> Answering:
    """A baseline that also takes ``source_normals=, target_normals=`` as a method on pairs."""

    def method(pair: Pair) -> Answer:
        normals = {
            "source_normals": pair.source_normals[: pair.source.count],
            "target_normals": pair.target_normals[: pair.target.count],
        }
        return Answer(baseline(_points(pair.source), _points(pair.target), **normals))

    return method


def from_network(params: Params) -> Network:
    """The network as a method on pairs."""
    predict = learned(params.config).predict

    @jax.jit
    def answer(pair: Pair, params: Params) -> Answer:
        return predict(params, pair.source, pair.target)

    return Network(answer, fold_params(params))  # once: no part of an answer


def from_refined_network(params: Params) -> Network:
    """The network's pose after `refine_multistart`: no ground truth, no normals given."""
    predict = learned(params.config).predict

    @jax.jit
    def refined(pair: Pair, params: Params) -> Answer:
        motion = predict(params, pair.source, pair.target).motion
        return Answer(refine_multistart(pair.source, pair.target, motion).target_from_source)

    return Network(refined, params)


def from_align(params: Params) -> Answering:
    """What a user gets: `align` of two arrays, whatever it needs to find that out."""

    def method(pair: Pair) -> Answer:
        found = align(_points(pair.source), _points(pair.target), params)
        motion = Rigid(jnp.float32(found.rotation), jnp.float32(found.translation))
        overlap = (
            np.pad(np.asarray(values, np.float32), (0, len(cloud.points) - len(values)))
            for values, cloud in (
                (found.source_overlap, pair.source),
                (found.target_overlap, pair.target),
            )
        )
        return Answer(motion, *map(jnp.asarray, overlap))

    return method


def from_true_overlap(params: Params) -> Network:
    """The registration network behind the true overlap labels: a bound, since it is told them.

    Its row has no overlap figures.
    """
    method = learned(params.config).predict_given_overlap
    assert method is not None  # only methods that have it get here

    @jax.jit
    def answer(pair: Pair, params: Params) -> Answer:
        labels = pair.source_overlap, pair.target_overlap
        return method(params, pair.source, pair.target, *labels)

    return Network(answer, params)


def _points(cloud: Cloud) -> np.ndarray:
    return np.asarray(cloud.points[: cloud.count])
