"""What the differences do: in pixels over the picture, in millimetres on the planes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.comparison.result import PixelMap, PlaneMap
from lasercal_gtsam.comparison.together import Together
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures.contours import contour_lines, even_levels
from lasercal_gtsam.figures.error_map import Contour, ErrorMap, error_map
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.figures.places import hull, inside
from lasercal_gtsam.figures.spots import used_spots
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.prediction import located_jacobian, pixel_by_camera
from lasercal_gtsam.projection import project_points, spot_on_ray
from lasercal_gtsam.report_map import CAMERA_TANGENT, PLANE_TANGENT
from lasercal_gtsam.units import MM_PER_M

Mask = npt.NDArray[np.bool_]

_COLUMNS = 24
_LEVELS = 5
# a plane seen nearly along itself is met anywhere: no farther than so many camera heights
_FARTHEST_HEIGHTS = 8.0


def pixel_maps(
    a: Calibration, b: Calibration, common: Cell, errors: Together
) -> tuple[PixelMap, ...]:
    """One for every common camera of equal picture size and every plane of A that it sees."""
    found = []
    for camera, part in common.cameras.items():
        if b.cell.cameras[camera].image_size != part.image_size:
            continue
        for plane in calibrated_cell(a).planes:
            one = _pixel_map(a, b, camera, plane, errors)
            if one is not None:
                found.append(one)
    return tuple(found)


def _pixel_map(
    a: Calibration, b: Calibration, camera: str, plane: str, errors: Together
) -> PixelMap | None:
    seen_by, other = a.cell.cameras[camera], b.cell.cameras[camera]
    w, h = seen_by.image_size
    rows = max(2, round(_COLUMNS * h / w))
    u = (np.arange(_COLUMNS) + 0.5) * w / _COLUMNS - 0.5
    v = (np.arange(rows) + 0.5) * h / rows - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    points = spot_on_ray(a.cell, uv, plane=plane, camera=camera)
    part, centre = a.cell.planes[plane], seen_by.T_base_camera[:3, 3]
    height = abs(part.distance - float(part.normal_base @ centre))
    away = np.linalg.norm(points - centre, axis=1)
    met = np.isfinite(away) & (away <= _FARTHEST_HEIGHTS * height)
    if not met.any():
        return None
    uv, points = uv[met], points[met]
    difference = project_points(points, other) - uv
    columns = _columns(errors, [f"{camera}.{t}" for t in CAMERA_TANGENT])
    J_a, J_b = (pixel_by_camera(points, cell.cameras[camera]) for cell in errors.cells)
    expected = _spread(J_a, J_b, columns, errors)
    border = hull(np.concatenate([_pixels(one, camera, plane) for one in (a, b)]))
    length = np.linalg.norm(difference, axis=1)
    both = np.isfinite(length)
    near = both & (inside(uv, border) if len(border) else True)
    if not near.any():  # a hull smaller than the grid, or B sees none of it
        near = both
    if not near.any():
        return None
    outside = length[both & ~near]
    return PixelMap(
        camera=camera,
        plane=plane,
        image_size=seen_by.image_size,
        uv=uv,
        difference_px=difference,
        expected_px=expected,
        near=near,
        median_px=float(np.median(length[near])),
        largest_px=float(length[near].max()),
        expected_median_px=float(np.median(expected[near])),
        outside_px=float(outside.max()) if len(outside) else None,
    )


def _pixels(calibration: Calibration, camera: str, plane: str) -> Array:
    seen = calibration.inputs.observations
    mine = used_spots(calibration) & (seen.camera == camera) & (seen.plane == plane)
    return np.asarray(seen.uv[mine])


def plane_maps(
    a: Calibration, b: Calibration, common: Cell, errors: Together
) -> tuple[PlaneMap, ...]:
    """One for every common plane and camera, where A has spots there or at least sees it."""
    found = []
    seen, used = a.inputs.observations, used_spots(a)
    for plane in common.planes:
        of_plane = [
            camera
            for camera in common.cameras
            if (used & (seen.plane == plane) & (seen.camera == camera)).any()
        ]
        for camera in of_plane or common.cameras:
            if a.cell.cameras[camera].image_size != b.cell.cameras[camera].image_size:
                continue
            try:
                base = error_map(a, plane, camera)
            except DataError:  # not seen, or no sigmas
                continue
            one = _plane_map(a, b, base, errors)
            if one is not None:
                found.append(one)
    return tuple(found)


def _plane_map(a: Calibration, b: Calibration, base: ErrorMap, errors: Together) -> PlaneMap | None:
    nodes = np.stack(np.meshgrid(base.x_mm, base.y_mm), axis=-1).reshape(-1, 2)
    uv = project_points(base.axes.to_base(nodes), a.cell.cameras[base.camera])
    uv[~np.isfinite(base.error_mm).ravel()] = np.nan
    here, there = (
        spot_on_ray(one.cell, uv, plane=base.plane, camera=base.camera) for one in (a, b)
    )
    J_a, J_b = (located_jacobian(cell, uv, base.plane, base.camera)[1] for cell in errors.cells)
    names = [f"{base.camera}.{t}" for t in CAMERA_TANGENT]
    names += [f"plane {base.plane}.{t}" for t in PLANE_TANGENT]
    expected = MM_PER_M * _spread(J_a, J_b, _columns(errors, names), errors)
    apart = MM_PER_M * np.linalg.norm(there - here, axis=1)
    known = np.isfinite(apart)
    near = base.near.ravel() & known
    if not near.any():
        return None
    worst = int(np.flatnonzero(near)[np.argmax(apart[near])])
    shape = base.error_mm.shape
    grid = apart.reshape(shape)
    within = base.seen.ravel() & known
    levels = even_levels(float(apart[within].min()), float(apart[within].max()), _LEVELS)
    outside = apart[within & ~near]
    return PlaneMap(
        plane=base.plane,
        camera=base.camera,
        axes=base.axes,
        x_mm=base.x_mm,
        y_mm=base.y_mm,
        difference_mm=grid,
        expected_mm=expected.reshape(shape),
        near=near.reshape(shape),
        contours=tuple(
            Contour(float(z), tuple(contour_lines(base.x_mm, base.y_mm, grid, float(z))))
            for z in levels
        ),
        hull_mm=base.hull_mm,
        view_mm=base.view_mm,
        spots_mm=base.spots_mm,
        median_mm=float(np.median(apart[near])),
        largest_mm=float(apart[worst]),
        largest_at_mm=nodes[worst],
        expected_median_mm=float(np.median(expected[near])),
        outside_mm=float(outside.max()) if len(outside) else None,
    )


def _columns(errors: Together, names: list[str]) -> npt.NDArray[np.int64]:
    where = {label: i for i, label in enumerate(errors.labels)}
    # a plane that B does not have moves no point of A's: only the camera's errors count
    return np.array([where[name] for name in names], dtype=np.int64)


def _spread(J_a: Array, J_b: Array, columns: npt.NDArray[np.int64], errors: Together) -> Array:
    """(N,) root mean squared length by noise of differences with derivatives (N, k, c)."""
    if not errors.known:
        return np.full(len(J_a), np.nan)
    root = J_b @ errors.root_b[columns] - J_a @ errors.root_a[columns]
    return np.asarray(np.sqrt(np.square(root).sum(axis=(1, 2))))
