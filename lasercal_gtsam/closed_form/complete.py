"""Cameras, lasers and planes that no pair could give alone, found from the parts that are known.

A second camera that saw only a few spots, a plane with three shots, a laser that was on for a
moment: each is easy once the others are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.closed_form.camera import KnownIntrinsics, Resection, cameras_from_points
from lasercal_gtsam.closed_form.linear import transformed
from lasercal_gtsam.closed_form.solution import NEGATIVE_DEPTH_PENALTY_PX
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL, pixel_scaling
from lasercal_gtsam.closed_form.triangulation import fit_plane
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import spot_on_beam, spot_on_ray, spot_triangulated
from lasercal_gtsam.rotations import make_pose, nearest_rotation

SPOTS_FOR_PLANE = 3
SPOTS_FOR_LASER = 3
SPOTS_FOR_CAMERA = 6
_FLATTEST = 0.02
"""Points narrower than this fraction of their length count as one line."""


def complete_cell(
    cell: Cell,
    observations: Observations,
    known: Mapping[str, KnownIntrinsics],
    reasons: list[str],
) -> Cell:
    """Add what is missing from a cell, as long as anything can be found.

    Parameters
    ----------
    cell : some cameras, lasers and planes, without distortion
    observations : all spots
    known : known intrinsics of each camera in scaled pixels
    reasons : why pairs could not be solved alone, for the message

    Raises
    ------
    DegenerateError
        Something stays unknown; the message names it.
    """
    found = True
    while found:
        found = False
        for name in _missing(observations.planes, cell.planes):
            plane = find_plane(cell, _usable(cell, observations, plane=name))
            if plane is not None:
                cell, found = replace(cell, planes={**cell.planes, name: plane}), True
        for name in _missing(observations.lasers, cell.lasers):
            laser = find_laser(cell, _usable(cell, observations, laser=name))
            if laser is not None:
                cell, found = replace(cell, lasers={**cell.lasers, name: laser}), True
        for name in _missing(observations.cameras, cell.cameras):
            camera = find_camera(cell, _usable(cell, observations, camera=name), known[name])
            if camera is not None:
                cell, found = replace(cell, cameras={**cell.cameras, name: camera}), True
    _refuse_incomplete(cell, observations, reasons)
    return cell


def is_complete(cell: Cell, observations: Observations) -> bool:
    """Whether the cell has every camera, laser and plane that the spots name."""
    return not (
        _missing(observations.cameras, cell.cameras)
        or _missing(observations.lasers, cell.lasers)
        or _missing(observations.planes, cell.planes)
    )


def find_plane(cell: Cell, spots: Observations) -> Plane | None:
    """Plane through triangulated spots, corrected (14); None with fewer than 3 or all in a line."""
    if len(spots) < SPOTS_FOR_PLANE:
        return None
    X = spot_triangulated(
        cell, spots.uv, spots.T_base_hand, camera=list(spots.camera), laser=list(spots.laser)
    )
    X = X[np.isfinite(X).all(axis=1)]
    if len(X) < SPOTS_FOR_PLANE or _flatness(X, 1) < _FLATTEST:
        return None
    return Plane.from_point(*fit_plane(X))


def find_laser(cell: Cell, spots: Observations) -> Beam | None:
    """Beam as the line through the spots in the hand frame, spots by camera ray and plane (12).

    None with fewer than 3 spots or where they lie too close together to give a direction.
    """
    if len(spots) < SPOTS_FOR_LASER:
        return None
    X = spot_on_ray(cell, spots.uv, plane=list(spots.plane), camera=list(spots.camera))
    good = np.isfinite(X).all(axis=1)
    R, t = spots.T_base_hand[good, :3, :3], spots.T_base_hand[good, :3, 3]
    in_hand = ((X[good] - t)[:, None, :] @ R)[:, 0]
    if len(in_hand) < SPOTS_FOR_LASER:
        return None
    centre = in_hand.mean(axis=0)
    _, s, Vt = np.linalg.svd(in_hand - centre, full_matrices=False)
    if s[0] < 3.0 * s[1] or not s[0] > 0:
        return None
    along = in_hand @ Vt[0]
    u = Vt[0] if np.median(along) > 0 else -Vt[0]
    q = centre - (centre @ u) * u
    nearest, farthest = (in_hand @ u).min(), (in_hand @ u).max()
    return Beam(u, q + min(0.0, nearest - 0.1 * (farthest - nearest)) * u)


def find_camera(cell: Cell, spots: Observations, known: KnownIntrinsics) -> Camera | None:
    """Camera from spots where the beam meets the plane (9): the best of `cameras_from_points`.

    None with fewer than 6 spots, or where none of the ways works.
    """
    if len(spots) < SPOTS_FOR_CAMERA:
        return None
    X = spot_on_beam(cell, spots.T_base_hand, plane=list(spots.plane), laser=list(spots.laser))
    size = spots.image_size[str(spots.camera[0])]
    scaling = pixel_scaling(size)
    xy = transformed(scaling, spots.uv)
    good = np.isfinite(X).all(axis=1)
    points, images, normals = [], [], []
    for p, name in enumerate(spots.planes):
        rows = np.flatnonzero(good & (spots.plane_index == p))
        if len(rows) >= 4 and _flatness(X[rows], 1) > _FLATTEST:
            points.append(X[rows])
            images.append(xy[rows])
            normals.append(cell.planes[name].normal_base)
    if not points:
        return None
    found = [
        (_fit(camera, X[good], xy[good]), camera)
        for _, camera in cameras_from_points(
            points, np.array(normals), images, known, IMAGE_DIAGONAL
        )
    ]
    if not found:
        return None
    best = min(found, key=lambda pair: pair[0])[1]
    K = np.linalg.solve(scaling, best.K)
    pose = make_pose(nearest_rotation(best.R), best.T)
    return Camera(Intrinsics(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2]), pose, size)


def _fit(camera: Resection, X: Array, xy: Array) -> float:
    """Rms distance (scaled pixels) plus the penalty for points behind the camera."""
    p = (X - camera.T) @ camera.R
    image = p @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = image[:, :2] / image[:, 2:] - xy
    rms = float(np.sqrt((error**2).sum(axis=1).mean()))
    return (rms if np.isfinite(rms) else np.inf) + NEGATIVE_DEPTH_PENALTY_PX * float(
        (p[:, 2] <= 0).mean()
    )


def _flatness(X: Array, i: int) -> float:
    """Ratio of singular value ``i`` to the first of the centred points."""
    s = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    return float(s[i] / s[0]) if s[0] > 0 else 0.0


def _missing(names: tuple[str, ...], parts: Mapping[str, object]) -> list[str]:
    return [name for name in names if name not in parts]


def _usable(cell: Cell, observations: Observations, **wanted: str) -> Observations:
    """Spots of the wanted part whose other two parts are known."""
    chosen = np.ones(len(observations), dtype=bool)
    for kind, parts in (("camera", cell.cameras), ("laser", cell.lasers), ("plane", cell.planes)):
        names = getattr(observations, kind)
        chosen &= names == wanted[kind] if kind in wanted else np.isin(names, list(parts))
    return observations[chosen]


def _refuse_incomplete(cell: Cell, observations: Observations, reasons: list[str]) -> None:
    needs = {
        "camera": f"at least {SPOTS_FOR_CAMERA} spots on planes and of lasers that are known, "
        "spread over the image and over two planes",
        "laser": f"at least {SPOTS_FOR_LASER} spots on planes that are known, near and far along "
        "the beam",
        "plane": f"at least {SPOTS_FOR_PLANE} spots that are not in one line",
    }
    problems = [
        f"{kind} {name!r} could not be found: it needs {needs[kind]}; it has "
        f"{int((getattr(observations, kind) == name).sum())} spots"
        for kind, names, parts in (
            ("camera", observations.cameras, cell.cameras),
            ("laser", observations.lasers, cell.lasers),
            ("plane", observations.planes, cell.planes),
        )
        for name in _missing(names, parts)
    ]
    if problems:
        raise DegenerateError("\n".join(problems + reasons))
