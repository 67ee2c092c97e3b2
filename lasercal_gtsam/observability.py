"""Which combinations of unknowns the data do not determine, in words and units.

The information is measured against a plausible range of each unknown (0.1 rad, 50 mm, 50 px, ...):
a singular value of ``R * range`` below one means that the data say less about that combination than
common sense does.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.calibration import WeakDirection
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

# singular value of the range-scaled information below which a direction is called weak / singular
WEAK = 1.0
SINGULAR = 1e-4
_NAMED_SHARE = 0.3

_RANGES = {
    "rot": 0.1, "trans": 0.05, "fu": 50.0, "fv": 50.0, "skew": 10.0, "u0": 50.0, "v0": 50.0,
    "k1": 0.2, "k2": 0.2, "p1": 0.02, "p2": 0.02,
    "slope": 0.1, "offset": 0.02, "normal": 0.1, "distance": 0.05,
}  # fmt: skip


def plausible_ranges(labels: tuple[str, ...]) -> Array:
    """Plausible range of each tangent coordinate (rad, m, px, 1) from its label."""
    return np.array([_RANGES[_kind(label)] for label in labels])


def weak_directions(
    R: Array, labels: tuple[str, ...], free: Array, threshold: float = WEAK
) -> tuple[WeakDirection, ...]:
    """Directions with a range-scaled singular value below ``threshold``, weakest first.

    Parameters
    ----------
    R : (m, n) square-root information in sigmas
    labels : n names of the tangent coordinates
    free : (n,) booleans: coordinates that are estimated
    """
    columns = np.flatnonzero(free)
    ranges = plausible_ranges(labels)[columns]
    _, values, Vt = np.linalg.svd(R[:, columns] * ranges)
    values = np.append(values, np.zeros(len(columns) - len(values)))
    found: list[WeakDirection] = []
    for i in np.argsort(values, kind="stable"):
        if values[i] >= threshold:
            break
        move = Vt[i]
        top = np.flatnonzero(np.abs(move) >= _NAMED_SHARE * np.abs(move).max())
        top = top[np.argsort(-np.abs(move[top]), kind="stable")][:6]
        sign = np.sign(move[top[0]])
        words = ", ".join(_amount(labels[columns[j]], sign * move[j] * ranges[j]) for j in top)
        found.append(WeakDirection(float(values[i]), words))
    return tuple(found)


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
