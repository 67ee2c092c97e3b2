"""What about a capture's geometry explains that something is weak: facts, numbers, limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.check.poses import SMALL_TURN_DEG, Turns
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import spot_on_ray
from lasercal_gtsam.units import DEG_PER_RAD

PARALLEL_DEG = 10.0
"""Angle below which planes count as parallel to each other."""
FACING_DEG = 15.0
"""Angle below which a single plane counts as parallel to the picture."""
ALIGNED_DEG = 10.0
"""Angle of a single plane's normal to a camera's coordinate plane that mixes up f_u and f_v."""
SMALL_SPAN = 0.5
"""Share of the picture's width and height that the spots should span."""
FEW_SPOTS = 30
GRAZING_DEG = 15.0
"""Angle to its plane below which a beam or a view makes a spot long and its place uncertain."""


class Cause(NamedTuple):
    """A fact of the geometry, and whether it is a reason for weakness."""

    words: str
    poor: bool


def causes_of(cell: Cell, observations: Observations) -> dict[str, Cause]:
    """The facts behind each kind of remedy: ``turn``, ``plane``, ``spread``, ``repeat``."""
    return {
        "turn": _turns(cell, observations),
        "plane": _planes(cell),
        "spread": _span(observations),
        "repeat": Cause(f"there are only {len(observations)} spots", len(observations) < FEW_SPOTS),
    }


def _turns(cell: Cell, observations: Observations) -> Cause:
    R = observations.T_base_hand[:, :3, :3]
    turns = Turns.of(R)
    first, second, third = turns.rms_deg
    if first < SMALL_TURN_DEG:
        return Cause(f"the hand turns by only {first:.1f} deg rms", True)
    if second < SMALL_TURN_DEG:
        return Cause(
            f"the hand turns about one axis only ({first:.0f} deg rms, {second:.1f} deg about any "
            "other)",
            True,
        )
    spread = min(
        _spread_deg(R[rows] @ cell.lasers[name].direction_hand)
        for name in observations.lasers
        if (rows := observations.laser == name).any()
    )
    if spread < SMALL_TURN_DEG:
        return Cause(
            f"the hand turns mostly about the beam, whose direction varies by {spread:.1f} deg rms",
            True,
        )
    return Cause(
        f"the hand turns by {first:.0f}, {second:.0f} and {third:.0f} deg rms about three axes",
        False,
    )


def _spread_deg(directions: Array) -> float:
    """Rms angle of unit vectors (N, 3) to their mean."""
    mean = directions.mean(axis=0)
    cosines = directions @ mean / np.linalg.norm(mean)
    return float(np.sqrt((np.arccos(np.clip(cosines, -1.0, 1.0)) ** 2).mean())) * DEG_PER_RAD


def _planes(cell: Cell) -> Cause:
    normals = np.array([plane.normal_base for plane in cell.planes.values()])
    if len(normals) > 1:
        cosines = np.clip(np.abs(normals @ normals.T), 0.0, 1.0)
        widest = float(np.arccos(cosines.min())) * DEG_PER_RAD
        if widest < PARALLEL_DEG:
            return Cause(f"all planes are within {widest:.0f} deg of parallel", True)
        return Cause(f"the planes differ by up to {widest:.0f} deg", False)
    in_camera = [normals[0] @ camera.T_base_camera[:3, :3] for camera in cell.cameras.values()]
    tilts = [float(np.arccos(min(1.0, abs(n[2])))) * DEG_PER_RAD for n in in_camera]
    if max(tilts) < FACING_DEG:
        return Cause(
            f"the only plane is within {max(tilts):.0f} deg of parallel to the picture", True
        )
    n = in_camera[int(np.argmax(tilts))]
    aside = float(np.arcsin(min(1.0, np.abs(n[:2]).min()))) * DEG_PER_RAD
    if aside < ALIGNED_DEG:
        axes = "y-z" if abs(n[0]) < abs(n[1]) else "x-z"
        return Cause(
            f"the only plane's normal lies within {aside:.0f} deg of the camera's {axes} plane, "
            "where f_u and f_v look alike",
            True,
        )
    return Cause(f"there is only one plane, tilted by {max(tilts):.0f} deg to the picture", True)


def _span(observations: Observations) -> Cause:
    spans = []
    for camera in observations.cameras:
        uv = observations.uv[observations.camera == camera]
        spans.append(np.ptp(uv, axis=0) / np.array(observations.image_size[camera]))
    width, height = np.min(spans, axis=0)
    text = (
        f"the spots span {100 * width:.0f} % of the picture's width and {100 * height:.0f} % of "
        "its height"
    )
    return Cause(text, bool(min(width, height) < SMALL_SPAN))


def grazing_shots(cell: Cell, observations: Observations) -> list[str]:
    """Planes that beams or views meet nearly along themselves: one sentence each."""
    found = []
    points = spot_on_ray(
        cell,
        observations.uv,
        plane=observations.plane.tolist(),
        camera=observations.camera.tolist(),
    )
    for name in observations.planes:
        rows = np.flatnonzero(observations.plane == name)
        n = cell.planes[name].normal_base
        beams = [
            observations.T_base_hand[k, :3, :3]
            @ cell.lasers[str(observations.laser[k])].direction_hand
            for k in rows
        ]
        views = [
            points[k] - cell.cameras[str(observations.camera[k])].T_base_camera[:3, 3] for k in rows
        ]
        for what, directions in (("beam", beams), ("view", views)):
            angles = _angles_to_plane_deg(np.array(directions), n)
            low = int((angles < GRAZING_DEG).sum())
            if low:
                found.append(
                    f"the {what} meets plane {name!r} at less than {GRAZING_DEG:.0f} deg in {low} "
                    f"of {len(rows)} shots (least {np.nanmin(angles):.0f} deg): the spots are long "
                    "there; turn the hand or the plane towards it"
                )
    return found


def _angles_to_plane_deg(directions: Array, normal: Array) -> Array:
    sines = np.abs(directions @ normal) / np.linalg.norm(directions, axis=1)
    return np.asarray(np.arcsin(np.clip(sines, 0.0, 1.0)) * DEG_PER_RAD)
