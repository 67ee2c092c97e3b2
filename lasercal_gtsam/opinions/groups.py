"""Leave one group out: how well the rest predicts the shots of one hand orientation on a plane.

To first order nothing has to be solved again: with ``G`` the group's block of ``I - H`` its
residuals become ``e = G^-1 r`` when it is left out, and their covariance is ``G^-1`` (noise of the
spots and uncertainty of the rest together).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.opinions.bench import Bench
from lasercal_gtsam.opinions.chances import f_above
from lasercal_gtsam.units import MM_PER_M

# smallest eigenvalue of I - H of a group whose spots the others still predict
_PREDICTED = 1e-6


@dataclass(frozen=True)
class LeftOut:
    """A group as the others predict it.

    Attributes
    ----------
    first : id of its first spot
    plane : its plane
    spots : their number
    rms_px, expected_px : root mean squared length of the prediction's error, and what the
        covariance says of it (spot noise included); NaN where the others do not determine it
    rms_mm, expected_mm : the same on the plane, seen from the camera
    chance : probability of an error as large, in sigmas, in a good calibration; NaN likewise
    """

    first: str
    plane: str
    spots: int
    rms_px: float
    expected_px: float
    rms_mm: float
    expected_mm: float
    chance: float


def leave_groups_out(bench: Bench) -> tuple[LeftOut, ...]:
    """Every group as the others predict it, in the order of the spots."""
    found = []
    unwhiten = np.asarray(np.linalg.inv(bench.whitening), dtype=np.float64)
    for g in _in_order(bench):
        rows = np.flatnonzero(bench.group == g)
        at = (2 * rows[:, None] + np.arange(2)).ravel()
        plane = str(bench.observations.plane[rows[0]])
        first = str(bench.observations.id[rows[0]])
        Q = bench.Q[at]
        # (I - Q Q^T)^-1 = I + Q (I - Q^T Q)^-1 Q^T, in the number of unknowns, not of spots
        values, vectors = np.linalg.eigh(np.eye(Q.shape[1]) - Q.T @ Q)
        rest = bench.dof - len(at)
        if values[0] < _PREDICTED:
            nan = float("nan")
            found.append(LeftOut(first, plane, len(rows), nan, nan, nan, nan, nan))
            continue
        root = Q @ vectors / np.sqrt(values)
        r = bench.residuals[at]
        e = r + root @ (root.T @ r)
        chi2 = float(r @ e)
        chance = float("nan")
        if rest > 0:
            left = max(bench.sse - chi2, 1e-12 * bench.sse)
            chance = f_above((chi2 / len(at)) / (left / rest), len(at), rest)
        to_plane = np.empty((len(rows), 3, 3))
        to_plane[:, :2] = bench.by_point[rows]
        to_plane[:, 2] = bench.cell.planes[plane].normal_base
        to_mm = np.asarray(MM_PER_M * np.linalg.inv(to_plane)[:, :, :2], dtype=np.float64)
        parts = root.reshape(len(rows), 2, -1)
        own = np.eye(2) + parts @ np.swapaxes(parts, 1, 2)
        errors = e.reshape(-1, 2, 1)
        found.append(
            LeftOut(
                first,
                plane,
                len(rows),
                *_error_and_expected(unwhiten[rows], errors, own),
                *_error_and_expected(to_mm, errors, own),
                chance,
            )
        )
    return tuple(found)


def _error_and_expected(M: Array, errors: Array, covariance: Array) -> tuple[float, float]:
    """Root mean squared length of ``M e`` over the spots, and what the covariance says of it."""
    seen = np.square(M @ errors).sum()
    variance = np.einsum("nij,njk,nik->", M, covariance, M)
    return float(np.sqrt(seen / len(M))), float(np.sqrt(variance / len(M)))


def _in_order(bench: Bench) -> list[int]:
    labels, first = np.unique(bench.group, return_index=True)
    return [int(labels[k]) for k in np.argsort(first)]
