"""Intrinsics from the image of the absolute conic, ``omega = K^-T K^-1``."""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.linear import null_vector
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array

_WITHOUT_SKEW = np.array([0, 2, 3, 4, 5])


def conic_rows(a: Array, b: Array) -> Array:
    """Rows (..., 6) with ``row . w = a' omega b`` for the six entries ``w`` of omega.

    In the order omega_11, 12, 13, 22, 23, 33; ``a`` and ``b`` are (..., 3).
    """
    return np.stack(
        [
            a[..., 0] * b[..., 0],
            a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0],
            a[..., 0] * b[..., 2] + a[..., 2] * b[..., 0],
            a[..., 1] * b[..., 1],
            a[..., 1] * b[..., 2] + a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 2],
        ],
        axis=-1,
    )


def intrinsics_from_conic(rows: Array, zero_skew: bool) -> Array:
    """``K`` (3, 3) from equations ``rows @ w = 0``, in the coordinates of the rows.

    Raises
    ------
    DegenerateError
        The conic is not positive definite: no camera explains the equations.
    """
    used = _WITHOUT_SKEW if zero_skew else np.arange(6)
    if len(rows) < len(used) - 1:
        raise DegenerateError(
            f"{len(rows)} equations for {len(used) - 1} intrinsics; more orientations or "
            "translations of the hand are needed"
        )
    w = np.zeros(6)
    w[used] = null_vector(rows[:, used])
    w = w if w[0] > 0 else -w
    omega = np.array([[w[0], w[1], w[2]], [w[1], w[3], w[4]], [w[2], w[4], w[5]]])
    try:
        L = np.linalg.cholesky(omega)
    except np.linalg.LinAlgError:
        raise DegenerateError(
            "the equations give no camera (the conic is not positive definite): too much noise for "
            "these motions, or the motions are not what they were commanded to be"
        ) from None
    K = np.linalg.inv(L.T)
    return np.asarray(K / K[2, 2])
