"""DBDNet as one pure function: two clouds in, one `Registration` out."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.overlap import OverlapNetwork
from dbdnet_jax.model.params import Params
from dbdnet_jax.model.registration import RegistrationNetwork
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import farthest_order, inverse_order, prefix_mask, prefix_order
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
    takes neighbours, sampling, selection and interpolation weights as given). Coordinates are
    expected at the scale the weights were trained at (the unit sphere for the CAD and ModelNet40
    weights). Where nothing can be estimated ``valid`` is False and the motion the identity.
    """
    if params.registration is None:
        raise ValueError(
            "register needs a registration network; these params hold only the overlap network. "
            "Use predict_overlap, or load a full checkpoint."
        )
    clouds, order = _stack(src, tgt, src_mask, tgt_mask)
    probability = _overlap(params, clouds)
    return _register(params, clouds, order, probability, (src.shape[0], tgt.shape[0]))


def predict_overlap(
    params: Params,
    source: Cloud,
    target: Cloud,
    dropout_key: PRNGKeyArray | None = None,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Overlap probabilities of both clouds' points, zero in the padding.

    With a ``dropout_key``, attention weights are dropped as in training.
    """
    clouds = _stack_clouds(source, target)
    probability = _overlap(params, clouds, dropout_key)
    return probability[0, : source.points.shape[0]], probability[1, : target.points.shape[0]]


def register_given_overlap(
    params: Params,
    source: Cloud,
    target: Cloud,
    source_overlap: Float[Array, " n"],
    target_overlap: Float[Array, " m"],
    dropout_key: PRNGKeyArray | None = None,
) -> Registration:
    """The registration network alone, on the points whose given overlap passes the threshold.

    Stage 2 of training, and the way to use a mask of one's own: 0 and 1 are probabilities too.
    """
    clouds = _stack_clouds(source, target)
    sizes = (source.points.shape[0], target.points.shape[0])
    size = clouds.points.shape[1]
    order = jnp.broadcast_to(jnp.arange(size), (2, size))
    probability = jnp.stack([_grow(source_overlap, size), _grow(target_overlap, size)])
    return _register(params, clouds, order, probability, sizes, dropout_key)


def _grow(x: jax.Array, size: int) -> jax.Array:
    """Pad the rows of ``x`` with zeros to ``size``."""
    return jnp.pad(x, [(0, size - x.shape[0])] + [(0, 0)] * (x.ndim - 1))


def _stack_clouds(source: Cloud, target: Cloud) -> Cloud:
    """Two clouds of any static sizes as one stack; padding, as everywhere, changes nothing."""
    size = max(source.points.shape[0], target.points.shape[0])
    points = jnp.stack([_grow(source.points, size), _grow(target.points, size)])
    points = points.astype(jnp.promote_types(points.dtype, jnp.float32))
    return Cloud(points, jnp.stack([jnp.asarray(source.count), jnp.asarray(target.count)]))


def _stack(src, tgt, src_mask, tgt_mask) -> tuple[Cloud, Int[Array, "2 n"]]:
    """Stack two clouds with masks; ``order[c, row]`` is the caller's row of a stacked row."""
    size = max(src.shape[0], tgt.shape[0])
    masks = [
        _grow(jnp.ones(x.shape[0], bool) if mask is None else mask, size)
        for x, mask in ((src, src_mask), (tgt, tgt_mask))
    ]
    keep = jnp.stack(masks)
    order = jax.vmap(prefix_order)(keep)
    source, target = (Cloud(x, jnp.asarray(x.shape[0])) for x in (src, tgt))
    points = jnp.take_along_axis(_stack_clouds(source, target).points, order[..., None], axis=1)
    return Cloud(points, jnp.sum(keep, axis=1)), order


def _prepare(clouds: Cloud, config: ModelConfig):
    """Centre both clouds and bring them into farthest-point order.

    Returns the clouds, the order, the released code's rows for query-down, and the centroids.
    What stands in the padding is overwritten, so that it cannot matter from here on.
    """
    size = clouds.points.shape[1]
    valid = jax.vmap(lambda count: prefix_mask(size, count))(clouds.count)[..., None]
    points = jnp.where(valid, clouds.points, 0.0)
    centroid = jnp.sum(points, axis=1) / jnp.maximum(clouds.count, 1)[:, None]
    if config.released:
        centroid = jnp.zeros_like(centroid)  # departure: the released network sees raw coordinates
    points = jnp.where(valid, points - centroid[:, None, :], 0.0)
    order = jax.lax.map(
        lambda cloud: farthest_order(*cloud), (jax.lax.stop_gradient(points), clouds.count)
    )
    ordered = Cloud(jnp.take_along_axis(points, order[..., None], axis=1), clouds.count)
    skip_rows = jax.vmap(inverse_order)(order) if config.released else None
    return ordered, order, skip_rows, centroid


def _overlap(params: Params, clouds: Cloud, dropout_key=None) -> Float[Array, "2 n"]:
    """Overlap probabilities in the clouds' own row order."""
    ordered, order, skip_rows, _ = _prepare(clouds, params.config)
    network = OverlapNetwork(params.config)
    logits = jnp.asarray(network.apply({"params": params.overlap}, ordered, skip_rows, dropout_key))
    size = logits.shape[1]
    valid = jax.vmap(lambda count: prefix_mask(size, count))(clouds.count)
    logits = jnp.take_along_axis(logits, jax.vmap(inverse_order)(order), axis=1)
    return jnp.where(valid, jax.nn.sigmoid(logits), 0.0)


def select(
    probability: Float[Array, " n"], count: Int[Array, ""], threshold: float, at_least: int
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Row order and count of the points that enter registration.

    The rows above the threshold in their given order or, where fewer than ``at_least`` pass, the
    ``at_least`` most probable ones in descending order (the released code's rule for a batch of
    one, here for any batch).
    """
    probability = jnp.where(prefix_mask(probability.shape[0], count), probability, -1.0)
    keep = probability > threshold
    enough = jnp.sum(keep) >= at_least
    order = jnp.where(enough, prefix_order(keep), jnp.argsort(-probability, stable=True))
    return order, jnp.where(enough, jnp.sum(keep), jnp.minimum(at_least, count))


def _register(params, clouds, order, probability, sizes, dropout_key=None) -> Registration:
    """Select, match, solve, and bring everything back to the caller's rows."""
    config = params.config
    chosen, count = jax.vmap(
        lambda p, c: select(p, c, config.overlap_threshold, config.min_points)
    )(jax.lax.stop_gradient(probability), clouds.count)
    kept = Cloud(jnp.take_along_axis(clouds.points, chosen[..., None], axis=1), count)
    motion, correspondence, targets, sampled, solvable = _iterate(params, kept, dropout_key)
    # Row r of the network is row `back[c, r]` of the caller's cloud c.
    back = jnp.take_along_axis(jnp.take_along_axis(order, chosen, axis=1), sampled, axis=1)
    from_caller = jax.vmap(inverse_order)(back)
    rows, columns = from_caller[0, : sizes[0]], from_caller[1, : sizes[1]]
    branches = [
        Branch(matrix[rows][:, columns], target[rows], jnp.sum(matrix, axis=1)[rows])
        for matrix, target in zip(correspondence, targets, strict=True)
    ]
    overlap = jnp.take_along_axis(probability, jax.vmap(inverse_order)(order), axis=1)
    solvable = solvable & jnp.all(count >= 3)
    identity = rigid.identity(motion.rotation.dtype)
    motion = jax.tree.map(lambda found, rest: jnp.where(solvable, found, rest), motion, identity)
    return Registration(
        rotation=motion.rotation,
        translation=motion.translation,
        src_overlap=overlap[0, : sizes[0]],
        tgt_overlap=overlap[1, : sizes[1]],
        src_kept=rows < count[0],
        tgt_kept=columns < count[1],
        rotation_branch=branches[0],
        translation_branch=branches[1],
        confidence=0.5 * (branches[0].confidence + branches[1].confidence),
        valid=solvable,
    )


def _iterate(params: Params, kept: Cloud, dropout_key):
    """Run the registration network ``config.iterations`` times on the selected clouds.

    Returns the motion, the last correspondences and soft targets of both branches (rows in the
    network's order), that order, and whether the last solve was determined.
    """
    config = params.config
    network = RegistrationNetwork(config)
    variables = {"params": params.registration}
    motion = rigid.identity(kept.points.dtype)
    features = None
    for step in range(config.iterations):
        key = None if dropout_key is None else jax.random.fold_in(dropout_key, step)
        moved = kept._replace(points=kept.points.at[0].set(rigid.apply(motion, kept.points[0])))
        ordered, order, skip_rows, centroid = _prepare(moved, config)
        if features is None or not config.released:
            # Departure of the released code: features of the unmoved source serve all iterations.
            features = network.apply(variables, ordered, skip_rows, method="encode")
        matrix = jnp.asarray(network.apply(variables, ordered, features, key, method="match"))
        increment, targets, solvable = _solve(matrix, ordered, centroid, config)
        # The released code returns the last increment instead of the composed motion.
        total = rigid.compose(increment, motion)
        motion = increment if config.released and step == config.iterations - 1 else total
    return motion, matrix, targets, order, solvable


def _solve(
    matrix: Float[Array, "2 n n"],
    ordered: Cloud,
    centroid: Float[Array, "2 3"],
    config: ModelConfig,
) -> tuple[Rigid, Float[Array, "2 n 3"], Bool[Array, ""]]:
    """R from the first branch's soft correspondences, t from the second's.

    The soft targets are returned in the target's own frame, centring undone.
    """
    source, target = ordered.points
    mass = jnp.sum(matrix, axis=2)
    soft = jnp.matmul(matrix, target, precision=HIGHEST)
    if config.released:
        # Departure: not divided by the row's mass, so slack pulls points to the origin, and every
        # kept row weighs the same.
        valid = prefix_mask(source.shape[0], ordered.count[0]).astype(source.dtype)
        weights = jnp.broadcast_to(valid, mass.shape)
    else:
        soft = soft / jnp.where(mass > 1e-12, mass, 1.0)[..., None]
        weights = mass
    of_rotation, singular = rigid.procrustes(source, soft[0], weights[0])
    of_translation, _ = rigid.procrustes(source, soft[1], weights[1])
    rotation = of_rotation.rotation
    translation = of_translation.translation + centroid[1]
    translation = translation - jnp.matmul(rotation, centroid[0], precision=HIGHEST)
    finite = jnp.all(jnp.isfinite(rotation)) & jnp.all(jnp.isfinite(translation))
    determined = (singular[1] > 1e-6) & jnp.all(jnp.sum(weights, axis=1) > 1e-6)
    return Rigid(rotation, translation), soft + centroid[None, 1:], finite & determined
