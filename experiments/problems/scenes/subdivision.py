"""Loop's subdivision of triangle meshes (Loop 1987) as sparse matrices, and the smooth bumps it makes of displacements.

One step splits every triangle into four. A new vertex is 3/8 of the two ends of its edge and 1/8 of the two corners
that face it; an old one with k neighbours is (1 - k b) of itself and b of each, b = (5/8 - (3/8 + cos(2 pi / k) / 4)^2)
/ k. A displacement of one coarse vertex becomes a bump over its neighbourhood, twice differentiable almost everywhere.

trimesh subdivides positions (a test compares) but does not return the matrix, whose columns are the bumps.
"""

import numpy as np
import numpy.typing as npt
from scipy import sparse

from experiments.problems.scenes.icosphere import Index, icosphere, split


def subdivision(faces: Index, count: int) -> sparse.csr_array:
    """One step on a closed mesh of triangles [k, 3] over `count` vertices.

    Returns: matrix [count + edges, count], rows in the order of the vertices of `split`; they sum to 1.
    """
    _, ends = split(faces, count)
    corners = np.concatenate([faces, np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)])
    key = np.sort(corners[:, :2], axis=1) @ [count, 1]
    edge = np.searchsorted(ends @ [count, 1], key)  # `ends` is sorted
    weights = np.broadcast_to([3 / 16, 3 / 16, 1 / 8], corners.shape)  # every edge is met twice
    rows = np.broadcast_to(edge[:, None], corners.shape)
    odd = sparse.coo_array((weights.ravel(), (rows.ravel(), corners.ravel())), (len(ends), count))
    stacked: sparse.csr_array = sparse.vstack([smoothing(faces, count), odd]).tocsr()
    return stacked


def smoothing(faces: Index, count: int) -> sparse.csr_array:
    """What a step does to the old vertices alone: matrix [count, count], rows sum to 1."""
    _, ends = split(faces, count)
    both = np.concatenate([ends, ends[:, ::-1]])
    neighbours = sparse.coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), (count, count)).tocsr()
    k = np.bincount(ends.ravel(), minlength=count)
    b: npt.NDArray[np.float64] = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / k) / 4) ** 2) / k
    smooth: sparse.csr_array = (sparse.diags_array(1 - k * b) + sparse.diags_array(b) @ neighbours).tocsr()
    return smooth


def bumps(coarse: int, fine: int) -> sparse.csr_array:
    """Displacements of the vertices of icosphere `fine`, for one of each vertex of icosphere `coarse`.

    Returns: matrix [vertices of fine, vertices of coarse], rows sum to 1; smoothing by one step where both are equal.

    Raises:
        ValueError: not 0 <= coarse <= fine.
    """
    if not 0 <= coarse <= fine:
        raise ValueError(f"coarse must be between 0 and fine = {fine}, got {coarse}")
    vertices, faces = icosphere(coarse)
    count = len(vertices)
    if coarse == fine:
        return smoothing(faces, count)
    product: sparse.csr_array = sparse.eye_array(count).tocsr()
    for _ in range(coarse, fine):
        step = subdivision(faces, count)
        faces, _ = split(faces, count)
        count, product = step.shape[0], (step @ product).tocsr()
    return product
