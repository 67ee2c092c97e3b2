"""Where the spots lie in each picture and on each plane, and where there are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.check.picture import FIELDS, coverage
from lasercal_gtsam.figures.places import (
    PlaneAxes,
    area,
    axes_of,
    clipped,
    hull,
    view_outline,
)
from lasercal_gtsam.figures.spots import (
    Index,
    places_of_spots,
    rejected_spots,
    sampled,
)
from lasercal_gtsam.frozen import Array, FrozenData

_COLUMNS = 16
_MM2_PER_CM2 = 100.0


@dataclass(frozen=True, eq=False)
class ImageCoverage(FrozenData):
    """Spots of one camera in its picture.

    Attributes
    ----------
    camera, image_size : which, (w, h) px
    counts : (rows, columns) spots in each field of the picture, the top row first
    total, shown : spots used, and the numbers of those listed
    uv : (K, 2) px of those
    hull_uv : (M, 2) convex hull of all spots used, and ``hull_share``, its part of the picture
    fields, fields_total : how many fields of a coarse division have a spot, and how many there are
    reach : distance of the farthest spot from the middle, as a share of that of a corner
    """

    camera: str
    image_size: tuple[int, int]
    counts: Index
    total: int
    shown: Index
    uv: Array
    hull_uv: Array
    hull_share: float
    fields: int
    fields_total: int
    reach: float


def image_coverages(calibration: Calibration) -> tuple[ImageCoverage, ...]:
    """One for each camera whose spots were used."""
    seen = calibration.inputs.observations
    used = np.flatnonzero(~rejected_spots(calibration))
    found = []
    for part in coverage(seen[used]) if len(used) else ():
        rows = used[seen.camera[used] == part.camera]
        w, h = seen.image_size[part.camera]
        uv = seen.uv[rows]
        border = hull(uv)
        fields = (_COLUMNS, max(1, round(_COLUMNS * h / w)))
        edges = [
            np.linspace(-0.5, size - 0.5, n + 1) for size, n in zip((w, h), fields, strict=True)
        ]
        counts = np.histogram2d(uv[:, 1], uv[:, 0], bins=(edges[1], edges[0]))[0]
        shown = sampled(rows)
        found.append(
            ImageCoverage(
                camera=part.camera,
                image_size=(w, h),
                counts=counts.astype(np.int64),
                total=len(rows),
                shown=shown,
                uv=seen.uv[shown],
                hull_uv=border,
                hull_share=area(border) / (w * h),
                fields=part.fields,
                fields_total=FIELDS[0] * FIELDS[1],
                reach=part.reach,
            )
        )
    return tuple(found)


@dataclass(frozen=True, eq=False)
class PlaneView(FrozenData):
    """The part of a plane that a camera sees: its outline (K, 2), mm, and how much has spots.

    ``share``: of the outline, what lies in the hull of the spots; None where there is no outline.
    """

    camera: str
    outline_mm: Array
    share: float | None


@dataclass(frozen=True, eq=False)
class PlaneCoverage(FrozenData):
    """Spots on one plane.

    Attributes
    ----------
    plane, axes : which, and its drawing axes
    total, shown : spots used, and the numbers of those listed
    xy_mm : (K, 2) where the camera saw them
    hull_mm, hull_cm2 : (M, 2) convex hull of all spots used, and its area
    views : what each camera sees of it
    rejected_mm : (R, 2) spots left out, where their rays meet the plane inside a view's bounds
    """

    plane: str
    axes: PlaneAxes
    total: int
    shown: Index
    xy_mm: Array
    hull_mm: Array
    hull_cm2: float
    views: tuple[PlaneView, ...]
    rejected_mm: Array


def plane_coverages(calibration: Calibration) -> tuple[PlaneCoverage, ...]:
    """One for each plane of the cell; a plane without spots of its own has an empty hull."""
    cell, seen = calibration.cell, calibration.inputs.observations
    out = rejected_spots(calibration)
    found = []
    for plane in cell.planes:
        mine = seen.plane == plane
        cameras = tuple(name for name in cell.cameras if (mine & (seen.camera == name)).any())
        axes = axes_of(cell, plane, cameras)
        rows = np.flatnonzero(mine & ~out)
        xy = axes.to_plane_mm(places_of_spots(calibration, rows))
        met = np.isfinite(xy).all(axis=1)
        rows, xy = rows[met], xy[met]
        border = hull(xy)
        views = tuple(
            _view(camera, view_outline(cell, plane, camera, axes), border)
            for camera in cameras or tuple(cell.cameras)
        )
        shown = sampled(np.arange(len(rows)))
        found.append(
            PlaneCoverage(
                plane=plane,
                axes=axes,
                total=len(rows),
                shown=rows[shown],
                xy_mm=xy[shown],
                hull_mm=border,
                hull_cm2=area(border) / _MM2_PER_CM2,
                views=views,
                rejected_mm=_rejected(calibration, np.flatnonzero(mine & out), axes, views),
            )
        )
    return tuple(found)


def _view(camera: str, outline: Array, border: Array) -> PlaneView:
    whole = area(outline)
    covered = area(clipped(outline, border)) if len(border) else 0.0
    return PlaneView(camera, outline, covered / whole if whole > 0 else None)


def _rejected(
    calibration: Calibration, rows: Index, axes: PlaneAxes, views: tuple[PlaneView, ...]
) -> Array:
    xy = axes.to_plane_mm(places_of_spots(calibration, sampled(rows)))
    corners = np.concatenate([np.zeros((0, 2)), *(view.outline_mm for view in views)])
    if not len(corners):
        return np.zeros((0, 2))
    low, high = corners.min(axis=0), corners.max(axis=0)
    return np.asarray(xy[((xy >= low) & (xy <= high)).all(axis=1)])
