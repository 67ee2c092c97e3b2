"""A new spot against what was expected of it, whitened for the tests that follow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.incremental.update import Innovations


class Innovation(NamedTuple):
    """One spot, as `lasercal_factors.stream_kernels.expect` sees it.

    Attributes
    ----------
    residual_px, covariance_px2 : (2,) predicted minus seen, and (2, 2) its covariance
    e : (2,) whitened residual; NaN where no spot can be
    by_parts : (2, 13) whitened derivatives by what may move: the camera's rotation and translation
        in its own frame, the beam's slopes and offsets, the plane's tilt and distance
    row, square : (2, n+1) what the spot adds to the square root of the information, and its squared
        residual (px^2), both where that is linearised
    """

    residual_px: Array
    covariance_px2: Array
    e: Array
    by_parts: Array
    row: Array
    square: float

    @property
    def chi2(self) -> float:
        """Squared whitened length; infinite where no spot can be."""
        a, b = self.e.tolist()
        chi2 = a * a + b * b
        return chi2 if math.isfinite(chi2) else math.inf

    @property
    def area(self) -> float:
        """Of one standard deviation, ``sqrt(det covariance)``, px^2."""
        (a, b), (_, c) = self.covariance_px2.tolist()
        return math.sqrt(a * c - b * b)


def innovations_of(labels: Sequence[str], seen: Sequence[Innovation | None]) -> Innovations:
    """As columns; NaN where nothing was expected."""
    count = len(labels)
    residual, covariance = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    chi2 = np.full(count, np.nan)
    for k, one in enumerate(seen[:count]):
        if one is not None:
            residual[k], covariance[k], chi2[k] = one.residual_px, one.covariance_px2, one.chi2
    return Innovations(np.array(labels, dtype=np.str_), residual, covariance, chi2)
