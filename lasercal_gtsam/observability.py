"""Which combinations of unknowns the data do not determine, in words and units.

The information is measured against a plausible range of each unknown (0.1 rad, 50 mm, 50 px, ...):
a singular value of ``R * range`` below one means that the data say less about that combination than
common sense does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.calibration import WeakDirection
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

# singular value of the range-scaled information below which a direction is called weak / singular
WEAK = 1.0
SINGULAR = 1e-4
# what is named of a direction: shares of its largest part, and how many
_NAMED_SHARE, _NAMED_COUNT = 0.3, 6
# undetermined directions that a sentence names
_SHOWN = 5

_RANGES = {
    "rot": 0.1, "trans": 0.05, "fu": 50.0, "fv": 50.0, "skew": 10.0, "u0": 50.0, "v0": 50.0,
    "k1": 0.2, "k2": 0.2, "p1": 0.02, "p2": 0.02,
    "slope": 0.1, "offset": 0.02, "normal": 0.1, "distance": 0.05,
}  # fmt: skip


def plausible_ranges(labels: tuple[str, ...]) -> Array:
    """Plausible range of each tangent coordinate (rad, m, px, 1) from its label."""
    return np.array([_RANGES[_kind(label)] for label in labels])


@dataclass(frozen=True, eq=False)
class RangeSvd:
    """Singular value decomposition of the range-scaled square-root information.

    Attributes
    ----------
    values : (m,) singular values, largest first; m free coordinates
    directions : (m, m) rows: the directions, in units of the ranges
    ranges : (m,) plausible ranges (rad, m, px, 1)
    labels : names of the free coordinates
    """

    values: Array
    directions: Array
    ranges: Array
    labels: tuple[str, ...]

    @classmethod
    def of(cls, R: Array, labels: tuple[str, ...], free: npt.NDArray[np.bool_]) -> RangeSvd:
        """Decompose ``R`` (rows, n), information in sigmas, over the ``free`` (n,) columns."""
        names = tuple(label for label, is_free in zip(labels, free, strict=True) if is_free)
        ranges = plausible_ranges(names)
        _, values, Vt = np.linalg.svd(R[:, free] * ranges, full_matrices=True)
        values = np.append(values, np.zeros(len(names) - len(values)))
        return cls(values, Vt, ranges, names)

    def root(self) -> Array:
        """(m, m) square root of the covariance; all singular values must be positive."""
        return np.asarray(self.directions.T / self.values * self.ranges[:, None])

    def covariance(self) -> Array:
        """(m, m) inverse of the information; all singular values must be positive."""
        root = self.root()
        return np.asarray(root @ root.T)

    def weak_directions(
        self, threshold: float = WEAK, sigma: float = 1.0
    ) -> tuple[WeakDirection, ...]:
        """Directions with a singular value below ``threshold``, weakest first.

        ``sigma`` multiplies the pixel sigmas that ``R`` was whitened with.
        """
        found: list[WeakDirection] = []
        with np.errstate(divide="ignore", invalid="ignore"):  # no noise at all
            strengths = np.where(self.values > 0.0, self.values / sigma, 0.0)
        for strength, move in zip(strengths[::-1], self.directions[::-1], strict=True):
            if strength >= threshold:
                break
            top = np.flatnonzero(np.abs(move) >= _NAMED_SHARE * np.abs(move).max())
            top = top[np.argsort(-np.abs(move[top]), kind="stable")][:_NAMED_COUNT]
            sign = np.sign(move[top[0]])
            words = ", ".join(_amount(self.labels[j], sign * move[j] * self.ranges[j]) for j in top)
            found.append(WeakDirection(float(strength), words))
        return tuple(found)


def undetermined(weak: Sequence[WeakDirection]) -> str:
    """What the spots leave open, for a sentence: how many directions, and the weakest of them."""
    shown = "; ".join(f"({i}) {w.words}" for i, w in enumerate(weak[:_SHOWN], start=1))
    more = f"; and {len(weak) - _SHOWN} more" if len(weak) > _SHOWN else ""
    count = f"{len(weak)} combination{'' if len(weak) == 1 else 's'}"
    return f"the spots leave {count} of unknowns undetermined: {shown}{more}"


def _kind(label: str) -> str:
    name = label.rpartition(".")[2]
    return name if name in _RANGES else name.partition("_")[0]


def _amount(label: str, value: float) -> str:
    kind = _kind(label)
    if kind in ("rot", "slope", "normal"):
        return f"{label} {value * DEG_PER_RAD:+.2g} deg"
    if kind in ("trans", "offset", "distance"):
        return f"{label} {value * MM_PER_M:+.2g} mm"
    if kind in ("fu", "fv", "skew", "u0", "v0"):
        return f"{label} {value:+.2g} px"
    return f"{label} {value:+.2g}"
