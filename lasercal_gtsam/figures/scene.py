"""The cell in space as lists of lines, polygons, points and labels in base coordinates.

Nothing here knows how it will be drawn: a viewer needs no more than these primitives, in layers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Camera
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures.contours import round_up
from lasercal_gtsam.figures.places import axes_of, clipped, hull, view_outline
from lasercal_gtsam.figures.spots import (
    Index,
    places_of_spots,
    rejected_spots,
    sampled,
)
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.projection import beam_in_base, ray_in_base
from lasercal_gtsam.report_map import CAMERA_TANGENT
from lasercal_gtsam.units import M_PER_MM

Kind = Literal["line", "polygon", "points", "label"]
Role = Literal["base", "hand", "camera", "laser", "plane", "spot", "rejected", "ellipsoid"]

MOST_HANDS, MOST_BEAMS = 60, 150
_CIRCLE = 24
_SHARE = 0.07
"""Longest half-axis of an ellipsoid as drawn, as a share of the scene's radius."""
_PLANE_MARGIN = 0.15
_FRUSTUM = 0.35


@dataclass(frozen=True, eq=False)
class Primitive(FrozenData):
    """Something to draw.

    Attributes
    ----------
    layer : which layer it belongs to
    kind : ``line`` (joined points), ``polygon`` (filled), ``points``, ``label`` (at the first)
    role : what it stands for
    points : (K, 3) metres, base
    name : the part of the cell
    axis : ``x``, ``y`` or ``z`` for an axis of a frame, else ""
    closed : a line that ends where it begins
    text : of a label
    """

    layer: str
    kind: Kind
    role: Role
    points: Array
    name: str = ""
    axis: str = ""
    closed: bool = False
    text: str = ""


@dataclass(frozen=True)
class Layer:
    """Primitives that are shown or hidden together; ``magnification`` where sizes are not true."""

    name: str
    label: str
    words: str
    visible: bool = True
    magnification: float | None = None


@dataclass(frozen=True, eq=False)
class Scene(FrozenData):
    """The cell.

    Attributes
    ----------
    layers, primitives : what there is
    centre, radius : (3,) and metres: the sphere that holds what matters
    azimuth_deg, elevation_deg : from where to look first, seen from the centre: azimuth from base x
        towards base y, up is base z
    """

    layers: tuple[Layer, ...]
    primitives: tuple[Primitive, ...]
    centre: Array
    radius: float
    azimuth_deg: float
    elevation_deg: float


def scene(calibration: Calibration) -> Scene:
    """The calibrated cell with its spots, beams, hand poses and uncertainties."""
    out = rejected_spots(calibration)
    used = np.flatnonzero(~out)
    places = places_of_spots(calibration, used)
    met = np.isfinite(places).all(axis=1)
    used, places = used[met], places[met]
    outlines = dict(_outlines(calibration, used, places))
    centre, radius = _sphere(calibration, used, places, outlines)
    size = 0.12 * radius
    parts = [
        *_frame("base", "base", np.eye(4), 1.6 * size, "base"),
        Primitive("base", "label", "base", np.zeros((1, 3)), "base", text="robot base"),
        *_planes(outlines),
        *_cameras(calibration, outlines, size, radius),
        *_spots(calibration, used, places, np.flatnonzero(out), outlines),
        *_beams(calibration, used, places),
        *_hands(calibration, used, size),
    ]
    ellipsoids, layers = _ellipsoids(calibration, used, places, outlines, radius)
    hands, beams = min(len(used), MOST_HANDS), min(len(used), MOST_BEAMS)
    every = (
        Layer("base", "robot base", "x red, y green, z blue"),
        Layer("planes", "planes", "the part with spots and a margin, where a camera sees it"),
        Layer("cameras", "cameras", "the frustum of each picture, cut off near the planes"),
        Layer("spots", "spots", "where the camera saw them on their planes"),
        Layer("rejected", "rejected spots", "spots that were left out", visible=bool(out.any())),
        Layer("beams", "laser beams", f"{beams} of {len(used)}, from the hand to the spot"),
        Layer("hands", "hand poses", f"{hands} of {len(used)}", visible=False),
        *layers,
    )
    present = {part.layer for part in (*parts, *ellipsoids)}
    azimuth, elevation = _eye(calibration, centre)
    return Scene(
        tuple(layer for layer in every if layer.name in present),
        (*parts, *ellipsoids),
        centre,
        radius,
        azimuth,
        elevation,
    )


def _outlines(calibration: Calibration, used: Index, places: Array) -> Iterator[tuple[str, Array]]:
    """Corners (K, 3) of what is drawn of each plane."""
    cell, seen = calibration.cell, calibration.inputs.observations
    for plane in cell.planes:
        mine = seen.plane[used] == plane
        cameras = tuple(c for c in cell.cameras if (mine & (seen.camera[used] == c)).any())
        axes = axes_of(cell, plane, cameras)
        views = [view_outline(cell, plane, camera, axes) for camera in cameras or cell.cameras]
        border = hull(axes.to_plane_mm(places[mine]))
        if len(border):
            low, high = border.min(axis=0), border.max(axis=0)
            margin = _PLANE_MARGIN * float((high - low).max())
            (x0, y0), (x1, y1) = low - margin, high + margin
            box = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
            corners = np.concatenate([np.zeros((0, 2)), *(clipped(v, box) for v in views)])
            shape = hull(corners) if len(corners) else box
            yield plane, axes.to_base(shape if len(shape) else box)
        elif any(len(view) for view in views):
            yield plane, axes.to_base(hull(np.concatenate(views)))


def _sphere(
    calibration: Calibration, used: Index, places: Array, outlines: dict[str, Array]
) -> tuple[Array, float]:
    """Middle and radius of planes, cameras and hands; the base only where it is not far away."""
    cameras = [c.T_base_camera[None, :3, 3] for c in calibration.cell.cameras.values()]
    hands = calibration.inputs.observations.T_base_hand[used, :3, 3]
    points = np.concatenate([places, hands, *cameras, *outlines.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    reach = float(np.linalg.norm(high - low)) / 2
    if np.linalg.norm((low + high) / 2) < 4 * reach:
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, M_PER_MM)


def _frame(layer: str, role: Role, T: Array, size: float, name: str) -> Iterator[Primitive]:
    for k, axis in enumerate("xyz"):
        ends = np.stack([T[:3, 3], T[:3, 3] + size * T[:3, k]])
        yield Primitive(layer, "line", role, ends, name, axis)


def _planes(outlines: dict[str, Array]) -> Iterator[Primitive]:
    for name, corners in outlines.items():
        yield Primitive("planes", "polygon", "plane", corners, name, closed=True)
        at = corners[[int(np.argmax(corners[:, 2]))]]
        yield Primitive("planes", "label", "plane", at, name, text=f"plane {name}")


def _cameras(
    calibration: Calibration, outlines: dict[str, Array], size: float, radius: float
) -> Iterator[Primitive]:
    corners = np.concatenate([np.zeros((0, 3)), *outlines.values()])
    for name, camera in calibration.cell.cameras.items():
        T = camera.T_base_camera
        ahead = (corners - T[:3, 3]) @ T[:3, 2]
        depth = float(np.median(ahead[ahead > 0])) if (ahead > 0).any() else radius
        rim = T[:3, 3] + _FRUSTUM * depth * _corner_rays(camera)
        yield Primitive("cameras", "line", "camera", np.vstack([rim, rim[:1]]), name, closed=True)
        for corner in rim:
            ends = np.stack([T[:3, 3], corner])
            yield Primitive("cameras", "line", "camera", ends, name)
        yield from _frame("cameras", "camera", T, size, name)
        yield Primitive("cameras", "label", "camera", T[None, :3, 3], name, text=f"camera {name}")


def _corner_rays(camera: Camera) -> Array:
    """(4, 3) rays through the picture's corners at depth 1; undistorted where the lens folds."""
    w, h = camera.image_size
    uv = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]])
    rays = ray_in_base(uv, camera)
    if np.isfinite(rays).all():
        return rays
    straight = np.column_stack([uv, np.ones(4)]) @ np.linalg.inv(camera.intrinsics.K).T
    return np.asarray(straight @ camera.T_base_camera[:3, :3].T)


def _spots(
    calibration: Calibration, used: Index, places: Array, out: Index, outlines: dict[str, Array]
) -> Iterator[Primitive]:
    seen = calibration.inputs.observations
    for plane in seen.planes:
        mine = np.flatnonzero(seen.plane[used] == plane)
        if len(mine):
            yield Primitive("spots", "points", "spot", places[sampled(mine)], plane)
        rows = sampled(out[seen.plane[out] == plane])
        points = places_of_spots(calibration, rows)
        near = np.isfinite(points).all(axis=1)
        if plane in outlines:  # a wild spot far away must not be drawn at the end of the world
            corners = outlines[plane]
            reach = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
            near &= np.linalg.norm(points - corners.mean(axis=0), axis=1) < 2 * reach
        if near.any():
            yield Primitive("rejected", "points", "rejected", points[near], plane)


def _beams(calibration: Calibration, used: Index, places: Array) -> Iterator[Primitive]:
    seen = calibration.inputs.observations
    for k in sampled(np.arange(len(used)), MOST_BEAMS):
        laser = str(seen.laser[used[k]])
        beam = calibration.cell.lasers[laser]
        T = seen.T_base_hand[used[k]]
        u, q = beam_in_base(T, beam)
        start = q + u * float(u @ (T[:3, 3] - q))  # the beam's point nearest to the hand
        end = q + u * float(u @ (places[k] - q))
        yield Primitive("beams", "line", "laser", np.stack([start, end]), laser)


def _hands(calibration: Calibration, used: Index, size: float) -> Iterator[Primitive]:
    seen = calibration.inputs.observations
    for k in sampled(used, MOST_HANDS):
        yield from _frame("hands", "hand", seen.T_base_hand[k], 0.4 * size, str(seen.id[k]))


def _ellipsoids(
    calibration: Calibration,
    used: Index,
    places: Array,
    outlines: dict[str, Array],
    radius: float,
) -> tuple[list[Primitive], list[Layer]]:
    """One-sigma ellipsoids of the cameras' positions and of located points, each group enlarged."""
    primitives, layers = list[Primitive](), list[Layer]()
    for layer, label, what, found in (
        (
            "camera-uncertainty",
            "uncertainty of cameras",
            "one-sigma ellipsoid of each camera's position",
            list(_camera_covariances(calibration)),
        ),
        (
            "plane-uncertainty",
            "uncertainty on planes",
            "one-sigma ellipsoids of points located from a pixel",
            list(_point_covariances(calibration, used, places, outlines)),
        ),
    ):
        sizes = [float(np.sqrt(np.linalg.eigvalsh(cov)[-1])) for _, _, cov in found]
        if not sizes or max(sizes) <= 0:
            continue
        magnification = round_up(_SHARE * radius / max(sizes))
        for name, centre, cov in found:
            primitives += _ellipsoid(layer, name, centre, cov, magnification)
        words = f"{what}, drawn {magnification:g} times as large as it is"
        layers.append(Layer(layer, label, words, magnification=magnification))
    return primitives, layers


def _camera_covariances(calibration: Calibration) -> Iterator[tuple[str, Array, Array]]:
    where = {label: i for i, label in enumerate(calibration.labels)}
    for name, camera in calibration.cell.cameras.items():
        labels = [f"{name}.{t}" for t in CAMERA_TANGENT[3:6]]
        if all(label in where for label in labels):
            at = [where[label] for label in labels]
            R = camera.T_base_camera[:3, :3]  # the tangent is in the camera's frame
            cov = R @ calibration.covariance[np.ix_(at, at)] @ R.T
            if np.isfinite(cov).all():
                yield name, camera.T_base_camera[:3, 3], cov


def _point_covariances(
    calibration: Calibration, used: Index, places: Array, outlines: dict[str, Array]
) -> Iterator[tuple[str, Array, Array]]:
    """Of the middle spot of each plane and camera, and of those farthest out."""
    seen = calibration.inputs.observations
    for plane in outlines:
        for camera in calibration.cell.cameras:
            mine = np.flatnonzero((seen.plane[used] == plane) & (seen.camera[used] == camera))
            if not len(mine):
                continue
            away = places[mine] - places[mine].mean(axis=0)
            directions = np.linalg.svd(away, full_matrices=False)[2][:2]
            along = away @ directions.T
            chosen = {int(np.argmin(np.linalg.norm(away, axis=1)))}
            chosen |= {int(k) for k in (*along.argmax(axis=0), *along.argmin(axis=0))}
            rows = used[mine[sorted(chosen)]]
            try:
                points, cov = calibration.locate(seen.uv[rows], plane=plane, camera=camera)
            except DataError:
                continue
            for point, C in zip(points, cov, strict=True):
                if np.isfinite(C).all():
                    yield plane, point, C


def _ellipsoid(
    layer: str, name: str, centre: Array, cov: Array, magnification: float
) -> list[Primitive]:
    """Three principal circles."""
    values, vectors = np.linalg.eigh(cov)
    axes = vectors * np.sqrt(np.maximum(values, 0.0)) * magnification
    angle = np.linspace(0.0, 2 * np.pi, _CIRCLE + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)])
    return [
        Primitive(layer, "line", "ellipsoid", centre + (axes[:, pair] @ ring).T, name, closed=True)
        for pair in ([0, 1], [1, 2], [0, 2])
    ]


def _eye(calibration: Calibration, centre: Array) -> tuple[float, float]:
    """A place to look from, in degrees: beside the first camera, and well above the planes."""
    first = next(iter(calibration.cell.cameras.values()))
    x, y, _ = first.T_base_camera[:3, 3] - centre
    return float(np.degrees(np.arctan2(y, x))) + 50.0, 25.0
