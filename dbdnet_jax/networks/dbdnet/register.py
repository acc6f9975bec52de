"""DBDNet as one pure function: two clouds in, one `Registration` out."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.networks.dbdnet.frames import (
    centred,
    geometry_of,
    move_source,
    pad_rows,
    reordered,
    select,
    stack_clouds,
    stack_masked,
    uncentred,
)
from dbdnet_jax.networks.dbdnet.iterations import iterate
from dbdnet_jax.networks.dbdnet.matching import SoftMatches
from dbdnet_jax.networks.dbdnet.overlap_pass import (
    apply_overlap_network,
    prepare_pair,
    probability_of_all,
)
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.sampling import inverse_order
from dbdnet_jax.types import Branch, Cloud, Registration, Rigid


def register(
    params: Params,
    src: Float[Array, "n 3"],
    tgt: Float[Array, "m 3"],
    src_mask: Bool[Array, " n"] | None = None,
    tgt_mask: Bool[Array, " m"] | None = None,
) -> Registration:
    """Register ``src`` to ``tgt``: no ground truth, no randomness, one static shape.

    Masks say which rows are points (all, if None); what stands in the other rows never matters.
    Pure, so `jax.jit`, `jax.vmap` and `jax.grad` with respect to the clouds apply (the derivative
    takes neighbours, sampling, selection and interpolation weights as given). With several
    `ModelConfig.overlap_passes` both networks take turns, each time on the clouds as aligned so
    far. Coordinates are expected at the scale the weights were trained at (the unit sphere for the
    CAD and ModelNet40 weights). Where nothing can be estimated ``valid`` is False and the motion
    the identity. Without an overlap network all points go to the registration network; where no
    overlap is predicted at all, that of every point is 1.

    Raises:
      ValueError: clouds of no or one row, or parameters of the overlap network alone.
    """
    _require_networks(params, src, tgt)
    clouds, order = stack_masked(src, tgt, src_mask, tgt_mask)
    sizes = src.shape[0], tgt.shape[0]
    if params.config.overlap != "prior":
        everywhere = clouds.valid.astype(clouds.points.dtype)
        geometry = geometry_of(clouds, params.config)
        return _register(params, clouds, order, everywhere, sizes, geometry)
    prepared = prepare_pair(params.config, clouds)
    start = rigid.identity(clouds.points.dtype)
    if params.config.overlap_passes == 1:
        logits = apply_overlap_network(params, prepared, start)[0]
        probability = probability_of_all(prepared, logits)
        return _register(params, clouds, order, probability, sizes, prepared.geometry)

    level = clouds._replace(points=clouds.points - prepared.centroid[:, None, :])

    def pass_and_register(motion: Rigid, _: None) -> tuple[Rigid, tuple[Rigid, Registration]]:
        logits = apply_overlap_network(params, prepared, motion)[0]
        moved = move_source(level, motion)
        probability = probability_of_all(prepared, logits)
        answer = _register(params, moved, order, probability, sizes, prepared.geometry)
        motion = rigid.compose(answer.motion, motion)
        return motion, (motion, answer)

    _, answers = jax.lax.scan(pass_and_register, start, length=params.config.overlap_passes)
    motion, answer = jax.tree.map(lambda leaf: leaf[-1], answers)
    motion = _identity_unless(answer.valid, uncentred(motion, prepared.centroid))
    branches = (
        branch._replace(target=branch.target + prepared.centroid[None, 1])
        for branch in (answer.rotation_branch, answer.translation_branch)
    )
    rotation_branch, translation_branch = branches
    return answer._replace(
        rotation=motion.rotation,
        translation=motion.translation,
        rotation_branch=rotation_branch,
        translation_branch=translation_branch,
    )


def _require_networks(params: Params, src: jax.Array, tgt: jax.Array) -> None:
    """Refuse half a network, and clouds without neighbours."""
    if params.registration is None:
        raise ValueError(
            "register needs DBDNet's registration network; these params hold "
            f"{', '.join(params.networks) or 'no network'}. Load a full set of its weights."
        )
    for name, cloud in (("src", src), ("tgt", tgt)):
        if cloud.shape[0] < 2:
            raise ValueError(
                f"{name} must be (n, 3) with n >= 2 (3 to be registered); got "
                f"{cloud.shape}. Give more points."
            )


def register_clouds(params: Params, source: Cloud, target: Cloud) -> Registration:
    """`register` of two clouds whose points are their first rows."""
    return register(params, source.points, target.points, source.valid, target.valid)


def predict_overlap(
    params: Params,
    source: Cloud,
    target: Cloud,
    dropout_key: PRNGKeyArray | None = None,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Overlap probabilities of both clouds' points, zero in the padding.

    With a ``dropout_key``, attention weights are dropped as in training.
    """
    return predict_overlap_and_matches(params, source, target, dropout_key)[:2]


def predict_overlap_and_matches(
    params: Params,
    source: Cloud,
    target: Cloud,
    dropout_key: PRNGKeyArray | None = None,
    start: Rigid | None = None,
) -> tuple[Float[Array, " n"], Float[Array, " m"], SoftMatches | None]:
    """`predict_overlap`, and the soft matches of a network that has them (else None).

    With a ``start``, a first idea of the motion, one pass from there. Otherwise
    `ModelConfig.overlap_passes` from the clouds with their centroids aligned, each from the motion
    that the matches of the one before ask for.

    Raises:
      ValueError: parameters without an overlap network.
    """
    if params.overlap is None:
        raise ValueError(
            "predict_overlap needs an overlap network; these params hold only the registration "
            "network. Use register, whose answer has a joint overlap where there is one."
        )
    prepared = prepare_pair(params.config, stack_clouds(source, target))

    def one_pass(motion: Rigid, _: None) -> tuple[Rigid, tuple[Array, SoftMatches | None]]:
        logits, matched = apply_overlap_network(params, prepared, motion, dropout_key)
        after = motion if matched is None else centred(matched.motion, prepared.centroid)
        return after, (logits, matched)

    passes = params.config.overlap_passes if start is None else 1
    still = rigid.identity(prepared.seen.points.dtype)
    start = still if start is None else centred(start, prepared.centroid)
    _, answers = jax.lax.scan(one_pass, start, length=passes)
    logits, matched = jax.tree.map(lambda leaf: leaf[-1], answers)
    probability = probability_of_all(prepared, logits)
    sizes = source.points.shape[0], target.points.shape[0]
    return probability[0, : sizes[0]], probability[1, : sizes[1]], matched


def register_given_overlap(
    params: Params,
    source: Cloud,
    target: Cloud,
    source_overlap: Float[Array, " n"],
    target_overlap: Float[Array, " m"],
    dropout_key: PRNGKeyArray | None = None,
    *,
    solves: int | None = None,
) -> Registration:
    """The registration network alone, on the points whose given overlap passes the threshold.

    Stage 2 of training, and the way to use a mask of one's own: 0 and 1 are probabilities too.
    A joint overlap is then predicted of those. It matches and solves ``solves`` times, each time on
    the clouds as aligned so far; as often as `ModelConfig.iterations` says, if None.
    """
    clouds = stack_clouds(source, target)
    sizes = (source.points.shape[0], target.points.shape[0])
    size = clouds.points.shape[1]
    order = jnp.broadcast_to(jnp.arange(size), (2, size))
    probability = jnp.stack([pad_rows(source_overlap, size), pad_rows(target_overlap, size)])
    geometry = geometry_of(clouds, params.config)
    return _register(params, clouds, order, probability, sizes, geometry, dropout_key, solves)


def _register(
    params: Params,
    clouds: Cloud,
    order: Int[Array, "2 rows"],
    probability: Float[Array, "2 rows"],
    sizes: tuple[int, int],
    geometry: Float[Array, "2 rows g"] | None,
    dropout_key: PRNGKeyArray | None = None,
    solves: int | None = None,
) -> Registration:
    """Select, match, solve, and bring everything back to the caller's rows."""
    config = params.config
    chosen, count = jax.vmap(
        lambda p, c: select(p, c, config.overlap_threshold, config.min_points)
    )(jax.lax.stop_gradient(probability), clouds.count)
    kept = Cloud(jnp.take_along_axis(clouds.points, chosen[..., None], axis=1), count)
    solved = iterate(
        params, kept, reordered(geometry, chosen), dropout_key, solves or config.iterations
    )
    matrix, matched, _ = solved.matches
    beyond = kept.points.shape[1] - matched.shape[1]
    correspondence = jnp.pad(matrix, ((0, 0), (0, beyond), (0, beyond)))
    targets = jnp.pad(solved.targets, ((0, 0), (0, beyond), (0, 0)))
    matched = jnp.pad(matched, ((0, 0), (0, beyond)))
    # Row r of the network is row `from_stack[c, r]` of the stack and `back[c, r]` of the caller's
    # cloud c.
    from_stack = jnp.take_along_axis(chosen, solved.order, axis=1)
    back = jnp.take_along_axis(order, from_stack, axis=1)
    from_caller = jax.vmap(inverse_order)(back)
    rows, columns = from_caller[0, : sizes[0]], from_caller[1, : sizes[1]]
    if solved.overlap is not None:
        found = jnp.where(kept.valid, jax.nn.sigmoid(solved.overlap), 0.0)
        probability = jnp.take_along_axis(found, jax.vmap(inverse_order)(from_stack), axis=1)
    branches = [
        Branch(matrix[rows][:, columns], target[rows], jnp.sum(matrix, axis=1)[rows])
        for matrix, target in zip(correspondence, targets, strict=True)
    ]
    overlap = jnp.take_along_axis(probability, jax.vmap(inverse_order)(order), axis=1)
    solvable = solved.determined & jnp.all(jnp.sum(matched, axis=1) >= 3)
    motion = _identity_unless(solvable, solved.motion)
    return Registration(
        rotation=motion.rotation,
        translation=motion.translation,
        src_overlap=overlap[0, : sizes[0]],
        tgt_overlap=overlap[1, : sizes[1]],
        src_kept=matched[0][rows],
        tgt_kept=matched[1][columns],
        rotation_branch=branches[0],
        translation_branch=branches[1],
        confidence=0.5 * (branches[0].confidence + branches[1].confidence),
        valid=solvable,
    )


def _identity_unless(valid: Bool[Array, ""], motion: Rigid) -> Rigid:
    identity = rigid.identity(motion.rotation.dtype)
    return jax.tree.map(lambda found, rest: jnp.where(valid, found, rest), motion, identity)
