"""The errors of two calibrations as one random vector.

To first order an estimate is off by ``G e``, with ``e`` the noise of its spots (and what its priors
are off by) in sigmas, and ``G`` the pseudo-inverse of its whitened derivative. Where two estimates
share measurements, they share their part of ``e``. With ``e`` of both laid out over the union of
the measurements, any difference ``J_b x_b - J_a x_a`` has the root ``J_b G_b - J_a G_a`` of its
covariance, exact for nested, overlapping and separate data alike, and for other options on the
same data. (Of nested data with the same options it is ``C_a - C_b``.)

A robust loss listens to ``w e`` instead of ``e``, with ``w`` the weights that it gave. Of shared
spots that is the same only so far as the two are correlated; the rest is laid out apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.comparison.inputs import measurements
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.opinions.bench import Bench, lay_out


@dataclass(frozen=True, eq=False)
class Together:
    """Errors of the coordinates that two calibrations have in common.

    Attributes
    ----------
    labels : n coordinates, tangent space, SI units
    root_a, root_b : (n, m) such that the errors are ``root z`` with ``z`` standard normal
    dof_a, dof_b : degrees of freedom behind the scale of each
    shared_spots, shared_priors : how many measurements and priors act on both
    cells : where the errors of each are linearised, tangent coordinates being about them; where
        spots are shared it is one place for both, or their curvature would pass for noise
    known : whether there are sigmas at all
    trouble : why shared spots could not be accounted for; "" where they were, or there are none
    """

    labels: tuple[str, ...]
    root_a: Array
    root_b: Array
    dof_a: float
    dof_b: float
    shared_spots: int
    shared_priors: int
    cells: tuple[Cell, Cell]
    known: bool
    trouble: str = ""

    def freedom(self, share_a: float) -> float:
        """Degrees of freedom of a variance of which A has this share (Satterthwaite).

        Where the two share spots they have one scale, known from the larger of the two.
        """
        if self.shared_spots:
            return max(self.dof_a, self.dof_b)
        share = float(np.clip(share_a, 0.0, 1.0))
        return 1.0 / (share**2 / self.dof_a + (1.0 - share) ** 2 / self.dof_b)


def lay_together(a: Calibration, b: Calibration, labels: tuple[str, ...]) -> Together:
    """The errors of ``labels`` in both; they must be in both."""
    known = all(np.isfinite(c.fit.sigma0) and np.isfinite(c.covariance).all() for c in (a, b))
    if not known:
        none = np.zeros((len(labels), 1))
        return Together(labels, none, none, np.nan, np.nan, 0, 0, (a.cell, b.cell), False)
    keys = [set(measurements(_used(c))) for c in (a, b)]
    common = len(keys[0] & keys[1])
    priors = [set(_prior_keys(c)) for c in (a, b)]
    shared_priors = len(priors[0] & priors[1])
    trouble = ""
    if common or shared_priors:
        if common:
            best = a if a.fit.dof > b.fit.dof else b
            a, b = _moved_to(a, best), _moved_to(b, best)
        try:
            roots, dof = _linked(a, b, labels), (a.fit.dof, b.fit.dof)
            return Together(labels, *roots, *dof, common, shared_priors, (a.cell, b.cell), True)
        except DataError as error:
            trouble = str(error)
    elif not (keys[0] and keys[1]):
        trouble = "one of them does not hold its spots"
    roots, dof = _separate(_block(a, labels), _block(b, labels)), (a.fit.dof, b.fit.dof)
    return Together(labels, *roots, *dof, 0, 0, (a.cell, b.cell), True, trouble)


def _moved_to(calibration: Calibration, other: Calibration) -> Calibration:
    """The calibration with the parts of another one, where that has them."""
    mine, theirs = calibration.cell, other.cell
    return replace(
        calibration,
        cell=Cell(
            {
                name: theirs.cameras[name]
                if name in theirs.cameras and theirs.cameras[name].image_size == part.image_size
                else part
                for name, part in mine.cameras.items()
            },
            {name: theirs.lasers.get(name, part) for name, part in mine.lasers.items()},
            {name: theirs.planes.get(name, part) for name, part in mine.planes.items()},
        ),
    )


def _used(calibration: Calibration) -> Observations:
    return calibration.inputs.observations[calibration.spots.weight > 0]


def _block(calibration: Calibration, labels: tuple[str, ...]) -> Array:
    where = {label: i for i, label in enumerate(calibration.labels)}
    at = [where[label] for label in labels]
    return np.asarray(calibration.covariance[np.ix_(at, at)])


def _separate(A: Array, B: Array) -> tuple[Array, Array]:
    root_a, root_b = _root(A), _root(B)
    return (
        np.hstack([root_a, np.zeros_like(root_b)]),
        np.hstack([np.zeros_like(root_a), root_b]),
    )


def _root(covariance: Array) -> Array:
    """Square root of a covariance that may be singular, scaled so that units do not matter."""
    sigma = np.sqrt(np.diag(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _linked(a: Calibration, b: Calibration, labels: tuple[str, ...]) -> tuple[Array, Array]:
    benches = lay_out(_evenly(a)), lay_out(_evenly(b))
    parts = [_gain(c, bench, labels) for c, bench in zip((a, b), benches, strict=True)]
    keys = [_row_keys(c, bench) for c, bench in zip((a, b), benches, strict=True)]
    scales = _common_scale((a, b), benches)
    column: dict[object, int] = {}
    for key in (*keys[0], *keys[1]):
        column.setdefault(key, len(column))
    roots = []
    alike = _likeness(a, b)
    for which, (gain, names, scale) in enumerate(zip(parts, keys, scales, strict=True)):
        root = np.zeros((len(labels), 3, len(column)))
        at = [column[name] for name in names]
        root[:, 0, at] = np.sqrt(alike) * scale * gain
        root[:, 1 + which, at] = np.sqrt(1.0 - alike) * scale * gain
        roots.append(root.reshape(len(labels), -1))
    # no more columns than rows are needed
    stacked = np.asarray(np.linalg.qr(np.vstack(roots).T, mode="r")).T
    return stacked[: len(labels)], stacked[len(labels) :]


def _gain(calibration: Calibration, bench: Bench, labels: tuple[str, ...]) -> Array:
    """(n, rows) from the whitened noise of a bench's rows to the errors of the coordinates."""
    length = np.linalg.norm(bench.A, axis=0)
    Q, R = np.linalg.qr(bench.A / length)
    gain = np.linalg.solve(R, Q.T) / length[:, None]
    where = {label: i for i, label in enumerate(bench.labels)}
    C = calibration.covariance
    sigma = dict(zip(calibration.labels, np.sqrt(np.diag(C)), strict=True))
    out = np.zeros((len(labels), gain.shape[1]))
    for k, label in enumerate(labels):
        if label in where:
            out[k] = gain[where[label]]
        elif sigma[label] > 0:  # fu that follows fv
            leader = label.removesuffix("fu") + "fv"
            out[k] = sigma[label] / sigma[leader] * gain[where[leader]]
    if not _weighted(calibration):
        return out
    # the scale of a robust loss is in its sigmas only
    stated = np.array([sigma[label] for label in labels])
    found = np.linalg.norm(out, axis=1)
    free = (found > 0) & (stated > 0)
    if free.any():
        out *= float(np.median(stated[free] / found[free]))
    return out


def _weighted(calibration: Calibration) -> bool:
    """Whether a loss gave weights other than 0 and 1."""
    return not np.isin(calibration.spots.weight, (0.0, 1.0)).all()


def _evenly(calibration: Calibration) -> Calibration:
    """The calibration with the weights of all spots used at 1: what a loss is linearised with."""
    spots = calibration.spots
    return replace(calibration, spots=replace(spots, weight=(spots.weight > 0).astype(np.float64)))


def _likeness(a: Calibration, b: Calibration) -> float:
    """Correlation of what the two listen to of the spots that they share; 1 without a loss."""
    if not (_weighted(a) or _weighted(b)):
        return 1.0
    heard = []
    for one in (a, b):
        used = one.spots.weight > 0
        pull = (one.spots.weight[:, None] * one.spots.residual_px)[used]
        heard.append(dict(zip(measurements(_used(one)), pull, strict=True)))
    shared = [key for key in heard[0] if key in heard[1]]
    if not shared:
        return 1.0
    x, y = (np.array([values[key] for key in shared]).ravel() for values in heard)
    return float(np.clip(x @ y / np.sqrt((x @ x) * (y @ y)), 0.0, 1.0))


def _row_keys(calibration: Calibration, bench: Bench) -> list[object]:
    """A key for each row of a bench: equal where the two share what the row was made from."""
    seen = bench.observations
    keys: list[object] = list(measurements(seen))
    for members in seen.shared_stops:  # their rows are mixed: they are shared as a whole
        for group in members.tolist():
            whole = tuple(keys[k] for k in group)
            for k in group:
                keys[k] = (keys[k], whole)
    rows: list[object] = [(key, axis) for key in keys for axis in (0, 1)]
    return [*rows, *_prior_keys(calibration)]


def _prior_keys(calibration: Calibration) -> list[object]:
    seen = calibration.inputs.observations
    if not len(seen):
        return []
    holds = resolve_holds(seen, calibration.options_used, calibration.cell)
    return [("prior", name, mean, sigma) for name, (mean, sigma) in holds.priors.items()]


def _common_scale(
    both: tuple[Calibration, Calibration], benches: tuple[Bench, Bench]
) -> tuple[float, float]:
    """Factors that give both the noise that they show together, by their degrees of freedom."""
    if any(map(_weighted, both)):
        return 1.0, 1.0
    areas = [
        dict(zip(measurements(bench.observations), np.linalg.det(bench.whitening), strict=True))
        for bench in benches
    ]
    shared = [key for key in areas[0] if key in areas[1]]
    if not shared:
        return 1.0, 1.0
    # sigma of A's spots over that of B's: the determinant is of two coordinates
    ratio = float(np.sqrt(np.median([areas[1][key] / areas[0][key] for key in shared])))
    dof = both[0].fit.dof, both[1].fit.dof
    pooled = float(np.sqrt((dof[0] * ratio**2 + dof[1]) / (dof[0] + dof[1])))
    return pooled / ratio, pooled
