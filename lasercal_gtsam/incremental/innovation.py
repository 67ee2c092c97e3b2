"""A new spot against what was expected of it, whitened for the tests that follow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.incremental.filter import Expected
from lasercal_gtsam.incremental.update import Innovations


class Innovation(NamedTuple):
    """One spot.

    Attributes
    ----------
    residual_px, covariance_px2 : (2,) predicted minus seen, and (2, 2) its covariance
    chi2 : squared whitened length; infinite where no spot can be
    e : (2,) whitened residual
    by_camera, by_laser, by_plane : (2, 6), (2, 4), (2, 3) whitened derivatives by what may move:
        rotation and translation in the camera frame; slopes and offsets; tilt and distance
    area : of one standard deviation, ``sqrt(det covariance)``, px^2
    """

    residual_px: Array
    covariance_px2: Array
    chi2: float
    e: Array
    by_camera: Array
    by_laser: Array
    by_plane: Array
    area: float

    @classmethod
    def of(cls, expected: Expected, scale: float) -> Innovation:
        """Whiten with the spot's noise (times ``scale``) and the estimate's own uncertainty."""
        (r0, r1), (w00, w01, w11), C, J = expected
        # C = L L^T
        l00 = math.sqrt(C[0, 0])
        l10 = C[1, 0] / l00
        l11 = math.sqrt(max(C[1, 1] - l10 * l10, 1e-300))
        white = np.array([[1.0 / l00, 0.0], [-l10 / (l00 * l11), 1.0 / l11]]) / scale
        e = white @ np.array([w00 * r0 + w01 * r1, w11 * r1])
        chi2 = float(e @ e)
        unwhite = np.array([[1.0 / w00, -w01 / (w00 * w11)], [0.0, 1.0 / w11]])
        by_plane = white @ J[:, 19:22]
        by_plane[:, 2] *= -1.0  # the rows' offset is GTSAM's, -d
        return cls(
            expected.residual,
            scale**2 * unwhite @ C @ unwhite.T,
            chi2 if math.isfinite(chi2) else math.inf,
            e,
            white @ J[:, :6],
            white @ J[:, 15:19],
            by_plane,
            scale**2 * l00 * l11 / (w00 * w11),
        )


def innovations_of(labels: Sequence[str], seen: Sequence[Innovation | None]) -> Innovations:
    """As columns; NaN where nothing was expected."""
    count = len(labels)
    residual, covariance = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    chi2 = np.full(count, np.nan)
    for k, one in enumerate(seen[:count]):
        if one is not None:
            residual[k], covariance[k], chi2[k] = one.residual_px, one.covariance_px2, one.chi2
    return Innovations(np.array(labels, dtype=np.str_), residual, covariance, chi2)
