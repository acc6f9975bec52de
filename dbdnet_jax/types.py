"""The nouns of the package: every room speaks in these records.

Points are rows, features last. A cloud of static size n holds its valid points in its first
``count`` rows; what stands in the rows after them is padding and never changes a result.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# What users give and get, on the host; two clouds of one function may differ in size.
Points = Float[np.ndarray, "n 3"]
OtherPoints = Float[np.ndarray, "m 3"]
Transform = Float[np.ndarray, "4 4"]  # b_from_a


class Cloud(NamedTuple):
    """A point cloud of static size; the valid points are the first ``count`` rows."""

    points: Float[Array, "n 3"]
    count: Int[Array, ""]  # type: ignore[assignment]  # not tuple.count

    @property
    def valid(self) -> Bool[Array, "*stack n"]:
        """Which rows are points; of stacked clouds, of each."""
        count = jnp.asarray(self.count)
        rows = jnp.arange(self.points.shape[-2], dtype=count.dtype).reshape(
            (1,) * count.ndim + (-1,)
        )
        return rows < count[..., None]


class Rigid(NamedTuple):
    """A rigid motion ``x -> rotation @ x + translation``, named ``target_from_source``."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]


class Answer(NamedTuple):
    """What any method says of a pair; None for what it does not say.

    ``motion`` is ``target_from_source``; the overlaps are probabilities of the rows of both clouds,
    both or none, zero in the padding.
    """

    motion: Rigid | None = None
    source_overlap: Float[Array, " n"] | None = None
    target_overlap: Float[Array, " m"] | None = None


class Pair(NamedTuple):
    """Two partially overlapping clouds and everything that is known of them.

    ``target ~ target_from_source(source)``. The overlap labels say which points have a
    counterpart in the other cloud; normals are unit vectors for the baselines that want them and
    are never seen by the network.
    """

    source: Cloud
    target: Cloud
    target_from_source: Rigid
    source_overlap: Bool[Array, " n"]
    target_overlap: Bool[Array, " m"]
    source_normals: Float[Array, "n 3"]
    target_normals: Float[Array, "m 3"]


class Branch(NamedTuple):
    """Soft correspondences of one branch, in the row order of the clouds as they were given.

    ``correspondence[i, j]`` is the mass that source point i gives to target point j (rows and
    columns sum to at most about 1, the rest went to the slack); ``target[i]`` is the point the
    row points at, ``confidence[i]`` the row's sum. Rows that were filtered out are zero.
    """

    correspondence: Float[Array, "n m"]
    target: Float[Array, "n 3"]
    confidence: Float[Array, " n"]


class Registration(NamedTuple):
    """The answer of the network for one pair: ``tgt ~ rotation @ src + translation``.

    ``src_overlap`` and ``tgt_overlap`` are probabilities (0 for masked-out rows), ``src_kept``
    and ``tgt_kept`` the rows that entered the registration network, ``confidence`` the mean of
    the two branches' row sums. Where ``valid`` is False nothing could be estimated and the
    motion is the identity.
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    src_overlap: Float[Array, " n"]
    tgt_overlap: Float[Array, " m"]
    src_kept: Bool[Array, " n"]
    tgt_kept: Bool[Array, " m"]
    rotation_branch: Branch
    translation_branch: Branch
    confidence: Float[Array, " n"]
    valid: Bool[Array, ""]

    @property
    def motion(self) -> Rigid:
        """The rotation and the translation."""
        return Rigid(self.rotation, self.translation)
