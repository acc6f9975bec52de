"""Which points belong to a cloud: no sentinels, no scattered returns, no heap far away.

As the statistical and the radius outlier removal of PCL and Open3D, but on a cloud that a voxel
grid has evened out, so that neither density nor copies of a point decide, and followed by a search
for clusters that stand apart. Nothing here depends on the order of the points.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from dbdnet_jax.alignment.voxels import MAX_CELLS, first_of_cells, voxel_keys
from dbdnet_jax.types import Points

BULK = 0.8  # part of the points that are taken for granted
FARTHEST = 20.0  # from the median, per distance that holds the bulk: beyond lie sentinels
CELLS = 24.0  # of the evening grid, per that distance
NEIGHBOURS = 8
LONELY = 4.0  # times the median distance to the eighth neighbour; surfaces stay below 3
APART = 1.0  # gap to the rest of a cluster that is left out, per the rest's size ...
MINORITY = 0.2  # ... where it holds less than this part of the occupied cells
FEWEST = 64  # cells; of fewer points little can be said


def inlying(points: Points) -> Bool[np.ndarray, " n"]:
    """Which points are no outliers; all where nothing stands out, and never none."""
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    bulk = float(np.quantile(distance, BULK))
    if bulk == 0.0:  # nearly all at one place: its distance says nothing of the others
        return np.ones(len(points), bool)
    inside = distance <= FARTHEST * bulk
    offsets = points[inside] - middle
    cell = max(bulk / CELLS, 2.001 * float(distance[inside].max()) / MAX_CELLS)
    keys = voxel_keys(offsets, cell)
    rows = first_of_cells(keys, offsets, cell)
    if len(rows) < FEWEST:
        return inside
    kept = rows[_main_cluster(offsets[rows])]
    inside[inside] = np.isin(keys, keys[kept])
    return inside


def _main_cluster(points: Points) -> Int[np.ndarray, " k"]:
    """Rows of even points that are not lonely and stand with the largest cluster of these."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    far, near = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    limit = LONELY * np.median(far[:, -1])
    company = far[:, -1] <= limit
    linked = (far <= limit) & company[:, None] & company[near]
    start, end = np.nonzero(linked)
    links = coo_array((np.ones(len(start)), (start, near[start, end])), (len(points),) * 2)
    labels = connected_components(links, directed=False)[1]
    rows = np.flatnonzero(company)
    return rows[_joined(points[rows], labels[rows], cKDTree)]


def _joined(points: Points, labels: Int[np.ndarray, " n"], tree: Any) -> Bool[np.ndarray, " n"]:
    """The largest cluster, what stands within its size of it, and so on; or all, if much is not."""
    names, sizes = np.unique(labels, return_counts=True)
    inside = labels == names[sizes.argmax()]
    while not inside.all():
        main = points[inside]
        size = np.quantile(np.linalg.norm(main - main.mean(axis=0), axis=1), 0.9)
        gap = tree(main).query(points, distance_upper_bound=max(APART * size, 1e-300))[0]
        joining = np.unique(labels[np.isfinite(gap) & ~inside])
        if not len(joining):
            break
        inside |= np.isin(labels, joining)
    return inside if inside.mean() > 1 - MINORITY else np.ones(len(points), bool)
