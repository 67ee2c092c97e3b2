"""How far a point may be off that is located on a working plane: a map in millimetres.

The expected error is the root of the mean squared distance between a located point and the true
one, ``sqrt(trace(C))`` with ``C`` the covariance of `Calibration.locate`: of the calibration alone,
for a pixel without noise of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures.contours import contour_lines, even_levels, row_of_levels
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.figures.places import (
    Mask,
    PlaneAxes,
    hull,
    inside,
    view_outline,
)
from lasercal_gtsam.figures.spots import places_of_spots, sampled, used_spots
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.prediction import only
from lasercal_gtsam.projection import point_jacobian, project_points, spot_on_ray
from lasercal_gtsam.units import MM_PER_M

Halves = tuple[Calibration, Calibration]

NODES = 41
"""Grid nodes along the longer side of a map."""
MARGIN = 0.25
"""What is drawn beyond the spots, as a share of their extent."""
_FEWEST_NODES = 9
_LEVELS = 4


@dataclass(frozen=True, eq=False)
class Contour(FrozenData):
    """Polylines (K, 2), mm, along which the error has the value of ``level_mm``."""

    level_mm: float
    lines: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class SplitMap(FrozenData):
    """The same map from two halves of the spots: half the distance between their answers.

    Half the difference of two independent halves has the covariance of the whole, so that the
    numbers compare with those of the expected error. It is one draw: it passes through zero where
    the halves happen to agree.

    Attributes
    ----------
    error_mm : (ny, nx) half the distance
    contours : as for the expected error
    rms_mm, expected_rms_mm : over the hull of the spots: root mean square, and what the covariances
        of the halves say of it
    """

    error_mm: Array
    contours: tuple[Contour, ...]
    rms_mm: float
    expected_rms_mm: float


@dataclass(frozen=True, eq=False)
class ErrorMap(FrozenData):
    """Expected error of located points on one plane, seen by one camera.

    Attributes
    ----------
    plane, camera, axes : which, and the plane's drawing axes
    x_mm, y_mm : (nx,), (ny,) grid nodes
    error_mm : (ny, nx) expected error; NaN where neither the node nor a neighbour is seen
    seen, near : (ny, nx) which nodes the camera sees, and which lie in the hull of the spots
    contours : lines of equal error at round values
    hull_mm, view_mm, spots_mm : hull of the spots, outline of the view, and the spots (a sample)
    total : spots used on that plane by that camera
    median_mm, largest_mm, largest_at_mm : over the hull (over the view where there are no spots)
    outside_mm : largest error that is seen outside the hull, on the map; None where nothing is
    across_mm : median sigma across the plane
    mm_per_px : median length on the plane of a pixel
    split : the same from split data, or None
    """

    plane: str
    camera: str
    axes: PlaneAxes
    x_mm: Array
    y_mm: Array
    error_mm: Array
    seen: Mask
    near: Mask
    contours: tuple[Contour, ...]
    hull_mm: Array
    view_mm: Array
    spots_mm: Array
    total: int
    median_mm: float
    largest_mm: float
    largest_at_mm: Array
    outside_mm: float | None
    across_mm: float
    mm_per_px: float
    split: SplitMap | None


def error_maps(calibration: Calibration, halves: Halves | None = None) -> tuple[ErrorMap, ...]:
    """A map for each plane and each camera that has spots there, or at least sees it.

    There are none without sigmas. Parts that nothing was observed of have none.

    Parameters
    ----------
    calibration : the whole
    halves : two halves of it (`opinions.split.fit_halves`), for the map from split data
    """
    seen, used = calibration.inputs.observations, used_spots(calibration)
    known = calibrated_cell(calibration)
    found = []
    for plane in known.planes:
        cameras = [
            camera
            for camera in known.cameras
            if (used & (seen.plane == plane) & (seen.camera == camera)).any()
        ]
        found += [_map(calibration, plane, camera, halves) for camera in cameras or known.cameras]
    return tuple(one for one in found if one is not None)


def error_map(
    calibration: Calibration,
    plane: str | None = None,
    camera: str | None = None,
    halves: Halves | None = None,
) -> ErrorMap:
    """The map of one plane as one camera sees it; see `error_maps`.

    Parameters
    ----------
    plane, camera : names; may be left out where the cell has only one

    Raises
    ------
    DataError
        A name is unknown, left out where there are several, or was not calibrated; there are no
        sigmas; or the camera does not see the plane.
    """
    known = calibrated_cell(calibration)
    plane = only(tuple(known.planes), plane, "plane")
    camera = only(tuple(known.cameras), camera, "camera")
    found = _map(calibration, plane, camera, halves)
    if found is None:
        why = (
            f"camera {camera!r} does not see plane {plane!r}"
            if np.isfinite(calibration.fit.sigma0)
            else "the calibration has no degrees of freedom left, and so no sigmas; add spots"
        )
        raise DataError(f"error map: {why}")
    return found


def _map(
    calibration: Calibration, plane: str, camera: str, halves: Halves | None
) -> ErrorMap | None:
    """The map; None without sigmas, or where the camera does not see the plane."""
    cell, seen = calibration.cell, calibration.inputs.observations
    part = cell.cameras[camera]
    axes = PlaneAxes.of(cell.planes[plane], part)
    rows = np.flatnonzero(used_spots(calibration) & (seen.plane == plane) & (seen.camera == camera))
    xy = axes.to_plane_mm(places_of_spots(calibration, rows))
    xy = xy[np.isfinite(xy).all(axis=1)]
    border, view = hull(xy), view_outline(cell, plane, camera, axes)
    if not len(view):
        return None
    x, y = _grid(border, view)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = axes.to_base(nodes)
    uv = project_points(points, part)
    with np.errstate(invalid="ignore"):
        in_view = ((uv >= -0.5) & (uv <= np.array(part.image_size) - 0.5)).all(axis=1)
    near = in_view & (inside(nodes, border) if len(border) else True)
    _, cov = calibration.locate(uv, plane=plane, camera=camera)
    shape = (len(y), len(x))
    error = MM_PER_M * np.sqrt(np.trace(cov, axis1=1, axis2=2))
    error[~_with_neighbours(in_view.reshape(shape)).ravel()] = np.nan
    if not np.isfinite(error[near]).any():
        return None
    in_view &= np.isfinite(error)
    near &= in_view
    levels = _levels(error[near], error[in_view])
    n = cell.planes[plane].normal_base
    outside = error[in_view & ~near]
    worst = int(np.flatnonzero(near)[np.argmax(error[near])])
    return ErrorMap(
        plane=plane,
        camera=camera,
        axes=axes,
        x_mm=x,
        y_mm=y,
        error_mm=error.reshape(shape),
        seen=in_view.reshape(shape),
        near=near.reshape(shape),
        contours=_contours(x, y, error.reshape(shape), levels),
        hull_mm=border,
        view_mm=view,
        spots_mm=xy[sampled(np.arange(len(xy)))],
        total=len(xy),
        median_mm=float(np.median(error[near])),
        largest_mm=float(error[worst]),
        largest_at_mm=nodes[worst],
        outside_mm=float(outside.max()) if len(outside) else None,
        across_mm=float(MM_PER_M * np.sqrt(np.median(np.einsum("i,nij,j->n", n, cov[near], n)))),
        mm_per_px=_mm_per_px(points[near], axes, calibration, camera),
        split=None
        if halves is None
        else _split_map(calibration, halves, plane, camera, uv, near, (x, y), levels),
    )


def _grid(border: Array, view: Array) -> tuple[Array, Array]:
    """Nodes (nx,) and (ny,) over the hull and its margin, or over the view where there is none."""
    low, high = view.min(axis=0), view.max(axis=0)
    if len(border):
        margin = MARGIN * float(np.ptp(border, axis=0).max())
        low = np.maximum(low, border.min(axis=0) - margin)
        high = np.minimum(high, border.max(axis=0) + margin)
    size = high - low
    counts = np.maximum(np.round((NODES - 1) * size / size.max()).astype(int) + 1, _FEWEST_NODES)
    return np.linspace(low[0], high[0], counts[0]), np.linspace(low[1], high[1], counts[1])


def _levels(near: Array, seen: Array) -> Array:
    """Even levels over what the spots surround, a 1-2-5 row over what lies outside."""
    low, high = float(near.min()), float(near.max())
    within = even_levels(low, high, _LEVELS)
    return np.unique(
        np.concatenate(
            [
                row_of_levels(float(seen.min()), low),
                within,
                row_of_levels(high, float(seen.max())),
            ]
        )
    )


def _with_neighbours(mask: Mask) -> Mask:
    """The nodes of a mask and the eight around each: a drawing then reaches the view's edge."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    out = np.zeros_like(mask)
    for j in range(3):
        for i in range(3):
            out |= padded[j : j + rows, i : i + columns]
    return out


def _contours(x: Array, y: Array, z: Array, levels: Array) -> tuple[Contour, ...]:
    return tuple(
        Contour(float(level), tuple(contour_lines(x, y, z, float(level)))) for level in levels
    )


def _mm_per_px(points: Array, axes: PlaneAxes, calibration: Calibration, camera: str) -> float:
    """Median over points of the side of the square on the plane that a pixel covers."""
    J = point_jacobian(points, calibration.cell.cameras[camera]) @ axes.basis
    return float(MM_PER_M * np.median(1.0 / np.sqrt(np.abs(np.linalg.det(J)))))


def _split_map(
    whole: Calibration,
    halves: Halves,
    plane: str,
    camera: str,
    uv: Array,
    near: Mask,
    grid: tuple[Array, Array],
    levels: Array,
) -> SplitMap:
    x, y = grid
    first, second = (spot_on_ray(part.cell, uv, plane=plane, camera=camera) for part in halves)
    error = 0.5 * MM_PER_M * np.linalg.norm(first - second, axis=1)
    variance = np.zeros(int(near.sum()))
    for part in halves:  # both with the noise of the whole
        noise = whole.fit.sigma0 / part.fit.sigma0
        _, cov = part.locate(uv[near], plane=plane, camera=camera)
        variance += noise**2 * np.trace(cov, axis1=1, axis2=2)
    shape = (len(y), len(x))
    return SplitMap(
        error.reshape(shape),
        _contours(x, y, error.reshape(shape), levels),
        _root_mean(error[near] ** 2),
        MM_PER_M * _root_mean(variance / 4.0),
    )


def _root_mean(squares: Array) -> float:
    return float(np.sqrt(np.nanmean(squares)))
