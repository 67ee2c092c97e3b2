"""More shots that could be taken, tried on the estimated cell before anybody takes them.

Each remedy adds virtual shots to a capture: the same hand turned about its spot, turned about the
beam, moved so that the spots fill the picture, or another plane. Only shots that would be seen
count. What they would add to the information is then computed, not guessed (`weakness`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Cell, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import project, spot_on_beam, spot_on_ray
from lasercal_gtsam.rotations import basis_of, rotation_exp
from lasercal_gtsam.units import RAD_PER_DEG

Kind = Literal["turn", "plane", "spread"]

SHOTS = 20
"""Shots that a remedy adds."""
SMALLEST_TURN_DEG = 20.0
NEW_PLANE = "new plane"
_FEWEST_SEEN = 0.6
_MARGIN_PX = 5.0
_SMALLEST_ANGLE = np.sin(15.0 * RAD_PER_DEG)
_PICTURE = 0.9


@dataclass(frozen=True, eq=False)
class Remedy:
    """Shots to add, what to tell the user, and the cell with any plane that comes with them."""

    kind: Kind
    words: str
    cell: Cell
    shots: Observations


def remedies(cell: Cell, observations: Observations) -> Iterator[Remedy]:
    """Every remedy that this cell allows, the easiest first.

    Parameters
    ----------
    cell : the estimate
    observations : the spots it comes from
    """
    few = _evenly(observations, SHOTS)
    for degrees in (SMALLEST_TURN_DEG, 35.0):
        yield from _kept("turn", _turn_words(degrees), cell, _turned(cell, few, degrees))
    yield from _kept("spread", _SPREAD, cell, _spread(cell, few))
    for degrees in (SMALLEST_TURN_DEG, 35.0):
        for azimuth in (0.0, 90.0, 180.0, 270.0):
            wider, shots = _on_new_plane(cell, few, degrees, azimuth)
            yield from _kept("plane", _plane_words(cell, degrees), wider, shots)


_SPREAD = (
    f"add {SHOTS} shots with the hand moved so that the spots reach the corners and edges of the "
    "picture"
)


def _turn_words(degrees: float) -> str:
    return f"add {SHOTS} shots with the hand turned by {degrees:g} deg or more about two axes"


def _plane_words(cell: Cell, degrees: float) -> str:
    against = "the one there is" if len(cell.planes) == 1 else "those there are"
    return (
        f"add a plane tilted by {degrees:g} deg or more against {against}, with {SHOTS} shots in "
        "all the hand orientations there are"
    )


def _kept(kind: Kind, words: str, cell: Cell, shots: Observations) -> Iterator[Remedy]:
    """The remedy with the shots that would be seen, if they are most of those planned."""
    seen = shots[_seen(cell, shots)]
    if len(seen) >= _FEWEST_SEEN * SHOTS:
        yield Remedy(kind, words, cell, seen)


def _evenly(observations: Observations, count: int) -> Observations:
    """About ``count`` spots, evenly over the rows."""
    rows = np.unique(np.linspace(0, len(observations) - 1, count).round().astype(int))
    return observations[np.resize(rows, count)]


def _with_poses(
    observations: Observations, T_base_hand: Array, planes: list[str] | None = None
) -> Observations:
    """The same cameras and lasers with other hand poses; pixels are not known yet."""
    return Observations.from_arrays(
        observations.uv,
        T_base_hand,
        plane=observations.plane.tolist() if planes is None else planes,
        image_size=observations.image_size,
        camera=observations.camera.tolist(),
        laser=observations.laser.tolist(),
        cov_uv=observations.cov_uv,
    )


def _turned(cell: Cell, few: Observations, degrees: float) -> Observations:
    """The hand turned about its own spot, which stays where it is: in turn about two hand axes.

    The axes are those across the beam, so that the beam's direction changes, each both ways.
    """
    T = few.T_base_hand.copy()
    X = spot_on_beam(cell, T, plane=few.plane.tolist(), laser=few.laser.tolist())
    for k in range(len(T)):
        beam = cell.lasers[str(few.laser[k])]
        axis = basis_of(beam.direction_hand)[:, (k // 2) % 2]
        angle = (1 if k % 2 else -1) * degrees * RAD_PER_DEG
        Q = rotation_exp(angle * (T[k, :3, :3] @ axis))
        T[k, :3, 3] = X[k] + Q @ (T[k, :3, 3] - X[k])
        T[k, :3, :3] = Q @ T[k, :3, :3]
    return _with_poses(few, T)


def _spread(cell: Cell, few: Observations) -> Observations:
    """The hand moved, not turned, so that the spots lie on the edges of the picture."""
    T = few.T_base_hand.copy()
    X = spot_on_beam(cell, T, plane=few.plane.tolist(), laser=few.laser.tolist())
    around = np.array([(-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1), (-1, 0), (1, 0)])
    for k in range(len(T)):
        camera = str(few.camera[k])
        size = np.array(few.image_size[camera])
        reach = _PICTURE if k % 2 else 0.5 * (1.0 + _PICTURE)
        uv = 0.5 * (size - 1) + 0.5 * size * reach * around[k % len(around)]
        target = spot_on_ray(cell, uv[None], plane=str(few.plane[k]), camera=camera)[0]
        T[k, :3, 3] += target - X[k]
    return _with_poses(few, np.where(np.isfinite(T), T, few.T_base_hand))


def _on_new_plane(
    cell: Cell, few: Observations, degrees: float, azimuth: float
) -> tuple[Cell, Observations]:
    """A plane through the middle of the spots, tilted against those there are; the same poses."""
    X = spot_on_beam(cell, few.T_base_hand, plane=few.plane.tolist(), laser=few.laser.tolist())
    name = max(cell.planes, key=lambda plane: int((few.plane == plane).sum()))
    mean = sum(
        (np.sign(p.normal_base @ cell.planes[name].normal_base) or 1.0) * p.normal_base
        for p in cell.planes.values()
    )
    n = np.asarray(mean) / np.linalg.norm(mean)
    towards = basis_of(n) @ np.array([np.cos(azimuth * RAD_PER_DEG), np.sin(azimuth * RAD_PER_DEG)])
    tilted = np.cos(degrees * RAD_PER_DEG) * n + np.sin(degrees * RAD_PER_DEG) * towards
    plane = Plane.from_point(tilted, np.nanmean(X, axis=0))
    wider = cell.with_planes({**cell.planes, NEW_PLANE: plane})
    return wider, _with_poses(few, few.T_base_hand, [NEW_PLANE] * len(few))


def _seen(cell: Cell, shots: Observations) -> npt.NDArray[np.bool_]:
    """Which shots would give a spot: in the picture, and no beam or view grazing its plane."""
    names = {
        "plane": shots.plane.tolist(),
        "laser": shots.laser.tolist(),
    }
    uv = project(cell, shots.T_base_hand, camera=shots.camera.tolist(), **names)
    X = spot_on_beam(cell, shots.T_base_hand, **names)
    good = np.array(np.isfinite(uv).all(axis=1) & np.isfinite(X).all(axis=1), dtype=np.bool_)
    for k in np.flatnonzero(good):
        camera = cell.cameras[str(shots.camera[k])]
        plane = cell.planes[str(shots.plane[k])]
        n = plane.normal_base
        beam = shots.T_base_hand[k, :3, :3] @ cell.lasers[str(shots.laser[k])].direction_hand
        view = X[k] - camera.T_base_camera[:3, 3]
        size = np.array(camera.image_size) - 1.0
        inside = np.all((uv[k] >= _MARGIN_PX) & (uv[k] <= size - _MARGIN_PX))
        shine = float(n @ beam)
        look = float(n @ view / np.linalg.norm(view))
        good[k] = inside and min(abs(shine), abs(look)) > _SMALLEST_ANGLE and shine * look > 0
    return good
