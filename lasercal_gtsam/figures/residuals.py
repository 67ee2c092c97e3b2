"""Residuals over the picture, and how they are distributed against what the noise gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.figures.contours import round_up
from lasercal_gtsam.figures.spots import Index, rejected_spots, sampled
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.opinions.bench import Bench

_ARROW = 0.04
"""Share of the picture's diagonal that an arrow of the 90 % quantile is drawn with."""
_FIELDS = 24
"""Fields across the picture over which many residuals are averaged."""
_BINS = (9, 31)
_CURVE = 121
_WIDEST_SIGMAS = 4.5


@dataclass(frozen=True, eq=False)
class MeanArrows(FrozenData):
    """Mean residual of each field of the picture that has spots.

    Attributes
    ----------
    columns, rows : how the picture is divided
    uv, residual_px : (K, 2) middle of the field, and the mean residual there, px
    count : (K,) spots in it
    magnification : with which these arrows are drawn
    """

    columns: int
    rows: int
    uv: Array
    residual_px: Array
    count: Index
    magnification: float


@dataclass(frozen=True, eq=False)
class ResidualField(FrozenData):
    """Residuals of one camera's spots over its picture.

    Attributes
    ----------
    camera, image_size : which, (w, h) px
    total : spots used; ``shown`` holds the numbers of those that the arrays are of
    uv, residual_px : (K, 2) where each was seen, and predicted minus seen, px
    rejected : numbers of the spots left out (a sample, where there are very many)
    rejected_uv, rejected_px : (R, 2) the same of those
    magnification : arrows are drawn this many times as long as the residual
    reference_px : a round residual for the legend
    rms_px, mean_px, largest_px : of all spots used: root mean squared length, mean (2,), longest
    means : fields, where the spots shown are a sample; else None
    """

    camera: str
    image_size: tuple[int, int]
    total: int
    shown: Index
    uv: Array
    residual_px: Array
    rejected: Index
    rejected_uv: Array
    rejected_px: Array
    magnification: float
    reference_px: float
    rms_px: float
    mean_px: Array
    largest_px: float
    means: MeanArrows | None


def residual_fields(calibration: Calibration) -> tuple[ResidualField, ...]:
    """One for each camera that saw spots."""
    seen, residual = calibration.inputs.observations, calibration.spots.residual_px
    out = rejected_spots(calibration)
    known = np.isfinite(residual).all(axis=1)
    found = []
    for camera in seen.cameras:
        mine = seen.camera == camera
        rows = np.flatnonzero(mine & ~out & known)
        left = sampled(np.flatnonzero(mine & out & known))
        size = seen.image_size[camera]
        lengths = np.linalg.norm(residual[rows], axis=1)
        typical = float(np.quantile(lengths, 0.9)) if len(rows) else 0.0
        magnification = _magnification(size, typical)
        shown = sampled(rows)
        found.append(
            ResidualField(
                camera=camera,
                image_size=size,
                total=len(rows),
                shown=shown,
                uv=seen.uv[shown],
                residual_px=residual[shown],
                rejected=left,
                rejected_uv=seen.uv[left],
                rejected_px=residual[left],
                magnification=magnification,
                reference_px=round_up(typical) if typical > 0 else 1.0,
                rms_px=_rms(lengths),
                mean_px=residual[rows].mean(axis=0) if len(rows) else np.zeros(2),
                largest_px=float(lengths.max(initial=0.0)),
                means=_means(seen.uv[rows], residual[rows], size)
                if len(shown) < len(rows)
                else None,
            )
        )
    return tuple(found)


def _means(uv: Array, residual: Array, size: tuple[int, int]) -> MeanArrows:
    columns = _FIELDS
    rows = max(1, round(columns * size[1] / size[0]))
    field = (uv + 0.5) / np.array(size) * (columns, rows)
    i, j = np.clip(field, 0, (columns - 1, rows - 1)).astype(np.int64).T
    labels, which, count = np.unique(j * columns + i, return_inverse=True, return_counts=True)
    sums = np.zeros((len(labels), 2))
    np.add.at(sums, which, residual)
    mean = sums / count[:, None]
    centre = np.column_stack([labels % columns, labels // columns]) + 0.5
    typical = float(np.quantile(np.linalg.norm(mean, axis=1), 0.9))
    return MeanArrows(
        columns,
        rows,
        centre / (columns, rows) * np.array(size) - 0.5,
        mean,
        count.astype(np.int64),
        _magnification(size, typical),
    )


def _magnification(size: tuple[int, int], typical_px: float) -> float:
    """A round number that draws a typical residual as a well visible arrow."""
    wanted = _ARROW * float(np.hypot(*size))
    return round_up(wanted / typical_px) if typical_px > 0 else 1.0


def _rms(lengths: Array) -> float:
    return float(np.sqrt(np.mean(lengths**2))) if len(lengths) else 0.0


@dataclass(frozen=True, eq=False)
class ResidualHistogram(FrozenData):
    """Coordinates of one camera's residuals (du and dv together) against their expectation.

    Attributes
    ----------
    camera : which
    edges_px : (n + 1,) edges of the bins
    counts : (n,) coordinates in each
    expected : (n,) how many the noise gives, each spot with its own covariance and what the fit
        took of it; None where that is not known
    curve_px, curve : (m,) the same smoothly: count in a bin of that width about each place
    coordinates, beyond : how many there are, and how many lie outside the edges
    rms_px, expected_rms_px : of a coordinate
    """

    camera: str
    edges_px: Array
    counts: Index
    expected: Array | None
    curve_px: Array
    curve: Array | None
    coordinates: int
    beyond: int
    rms_px: float
    expected_rms_px: float | None


def residual_histograms(
    calibration: Calibration, bench: Bench | None
) -> tuple[ResidualHistogram, ...]:
    """One for each camera that saw spots.

    Parameters
    ----------
    calibration : whose residuals
    bench : the same laid out; None where it cannot be, and there is then no expectation
    """
    seen, residual = calibration.inputs.observations, calibration.spots.residual_px
    used = ~rejected_spots(calibration)
    sigma = np.full((len(seen), 2), np.nan)
    if bench is not None:
        counted = calibration.spots.weight > 0
        # a loss that trusts a spot less does not make its noise larger
        trust = np.sqrt(calibration.spots.weight[counted])
        sigma[counted] = trust[:, None] * residual_sigmas(bench)
    found = []
    for camera in seen.cameras:
        rows = used & (seen.camera == camera) & np.isfinite(residual).all(axis=1)
        if not rows.any():
            continue
        values = residual[rows].ravel()
        rms = _rms(values)
        spread = sigma[rows].ravel()
        known = bool(np.isfinite(spread).all())
        typical = float(np.sqrt(np.mean(spread**2))) if known else rms
        edges = _edges(values, max(typical, rms))
        width = edges[1] - edges[0]
        curve_px = np.linspace(edges[0], edges[-1], _CURVE)
        counts = np.histogram(values, edges)[0].astype(np.int64)
        found.append(
            ResidualHistogram(
                camera=camera,
                edges_px=edges,
                counts=counts,
                expected=_between(edges[:-1], edges[1:], spread) if known else None,
                curve_px=curve_px,
                curve=_between(curve_px - width / 2, curve_px + width / 2, spread)
                if known
                else None,
                coordinates=len(values),
                beyond=len(values) - int(counts.sum()),
                rms_px=rms,
                expected_rms_px=typical if known else None,
            )
        )
    return tuple(found)


def residual_sigmas(bench: Bench) -> Array:
    """(N, 2) sigma of each coordinate of a residual: noise, less what the fit takes of it, px.

    With ``W`` the whitening of a spot and ``H`` the projector of the fit, the covariance of its
    residual is ``W^-1 (I - H) W^-T``. (Of spots that share an error of the hand it is nearly so:
    ``H`` is then that of the rows which make them independent.)
    """
    own = bench.Q[: 2 * len(bench)].reshape(len(bench), 2, -1)
    left = np.eye(2) - own @ np.swapaxes(own, 1, 2)
    back = np.linalg.inv(bench.whitening)
    covariance = back @ left @ np.swapaxes(back, 1, 2)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _between(low: Array, high: Array, sigma: Array) -> Array:
    """Expected number of normal values between each pair of limits; equal sigmas taken together."""
    sizes, count = np.unique(np.maximum(sigma, 1e-12).round(6), return_counts=True)
    sizes = np.maximum(sizes, 1e-12)
    out = np.zeros(len(low))
    for chunk in np.array_split(np.arange(len(sizes)), max(1, len(sizes) // 4096)):
        s = sizes[chunk]
        inside = ndtr(high[:, None] / s) - ndtr(low[:, None] / s)
        out += inside @ count[chunk]
    return out


def _edges(values: Array, sigma: float) -> Array:
    """Bins of a round width about zero, as wide as the values need, or 4.5 sigmas."""
    if sigma <= 0:
        return np.linspace(-1.0, 1.0, _BINS[0] + 1)
    reach = min(float(np.abs(values).max()), _WIDEST_SIGMAS * sigma)
    reach = max(reach, 2.5 * sigma)
    wanted = np.clip(1.6 * np.cbrt(len(values)), *_BINS)
    half = int(np.ceil(wanted / 2))
    return np.linspace(-1.0, 1.0, 2 * half + 1) * reach * (1 + 1e-9)
