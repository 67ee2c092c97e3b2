"""Linear algebra shared by the stages: null vectors, Hartley scaling, homographies, scaled solves.

Everything is vectorised over leading dimensions. A point set that is shorter than the stack it sits
in is padded, and ``present`` (1 or 0 for each point) says which entries count.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.frozen import Array


def null_vector(A: Array) -> Array:
    """Unit vector ``x`` that minimises ``|A x|``: last right singular vector, (..., columns)."""
    return np.asarray(np.linalg.svd(_tall(A), full_matrices=False)[2][..., -1, :])


def null_vector_and_gap(A: Array) -> tuple[Array, float]:
    """Null vector of one matrix and how well it is determined.

    The second value is the ratio of the last but one to the first singular value: zero (to
    rounding) means that more than one vector solves the system.
    """
    _, s, Vt = np.linalg.svd(_tall(A), full_matrices=False)
    return Vt[-1], float(s[-2] / s[0]) if s[0] > 0 else 0.0


def _tall(A: Array) -> Array:
    """Pad with zero rows to at least as many rows as columns, so that the thin SVD is complete."""
    missing = A.shape[-1] - A.shape[-2]
    if missing <= 0:
        return A
    return np.concatenate([A, np.zeros((*A.shape[:-2], missing, A.shape[-1]))], axis=-2)


def scaled_solve(A: Array, b: Array) -> tuple[Array, float]:
    """Least squares ``A x = b`` after scaling the columns to unit length.

    Returns the solution and the ratio of the smallest to the largest singular value of the scaled
    matrix: zero (to rounding) means that the data do not determine all unknowns.
    """
    scale = np.linalg.norm(A, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    U, s, Vt = np.linalg.svd(_tall(A / scale), full_matrices=False)
    if not s[0] > 0:
        return np.zeros(A.shape[1]), 0.0
    safe = np.maximum(s, np.finfo(np.float64).eps * s[0])
    x = Vt.T @ ((U[: len(b)].T @ b) / safe) / scale
    return x, float(s[-1] / s[0])


def hartley(points: Array, present: Array | None = None) -> Array:
    """Similarity that moves the centroid to 0 and the rms radius to sqrt(2).

    Parameters
    ----------
    points : (..., n, d)
    present : (..., n), optional; 1 where a point counts

    Returns
    -------
    (..., d+1, d+1) array acting on homogeneous points
    """
    d = points.shape[-1]
    w = np.ones(points.shape[:-1]) if present is None else present
    total = np.maximum(w.sum(-1), 1.0)[..., None]
    centre = (points * w[..., None]).sum(-2) / total
    spread = (((points - centre[..., None, :]) ** 2).sum(-1) * w).sum(-1) / total[..., 0]
    scale = np.sqrt(2.0 / np.where(spread > 0, spread, 1.0))
    S = np.zeros((*points.shape[:-2], d + 1, d + 1))
    for i in range(d):
        S[..., i, i] = scale
        S[..., i, d] = -scale * centre[..., i]
    S[..., d, d] = 1.0
    return S


def homogeneous(x: Array) -> Array:
    """Append a coordinate 1: (..., d) to (..., d+1)."""
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def transformed(S: Array, x: Array) -> Array:
    """Apply an affine map (..., d+1, d+1) to points (..., n, d); returns (..., n, d)."""
    d = x.shape[-1]
    return np.asarray(x @ np.swapaxes(S[..., :d, :d], -1, -2) + S[..., None, :d, d])


def dlt_rows(x: Array, xy: Array, present: Array | None = None) -> Array:
    """Rows of the direct linear transform ``(xy, 1) ~ H x``.

    Parameters
    ----------
    x : (..., n, k) source points, homogeneous
    xy : (..., n, 2) image points
    present : (..., n), optional

    Returns
    -------
    (..., 2n, 3k) array; its null vector is ``H`` row by row
    """
    *lead, n, k = np.broadcast_shapes(x.shape, (*xy.shape[:-1], x.shape[-1]))
    if present is not None:
        x = x * present[..., None]
    rows = np.zeros((*lead, n, 2, 3 * k))
    rows[..., 0, :k] = x
    rows[..., 1, k : 2 * k] = x
    rows[..., 0, 2 * k :] = -xy[..., 0, None] * x
    rows[..., 1, 2 * k :] = -xy[..., 1, None] * x
    return rows.reshape(*lead, 2 * n, 3 * k)


def dlt(x: Array, xy: Array, present: Array | None = None) -> Array:
    """Map ``H`` (..., 3, d+1) with ``(xy, 1) ~ H (x, 1)``, Hartley scaling on both sides.

    ``d`` = 2: homography from 4 points or more; ``d`` = 3: camera matrix or the paper's map from
    translations to pixels, from 6 points or more. The sign makes the third coordinate positive on
    most points; the scale is free (unit Frobenius norm before the scaling is undone).
    """
    Sx, Sm = hartley(x, present), hartley(xy, present)
    rows = dlt_rows(homogeneous(transformed(Sx, x)), transformed(Sm, xy), present)
    H = null_vector(rows).reshape(*rows.shape[:-2], 3, -1)
    H = np.asarray(np.linalg.solve(Sm, H @ Sx))
    third = (homogeneous(x) @ H[..., 2, :, None])[..., 0]
    positive = np.sign(third) if present is None else np.sign(third) * present
    sign = np.where(positive.sum(-1) < 0, -1.0, 1.0)
    return np.asarray(H * sign[..., None, None])
