"""Pairs of calibrations that the tests of comparisons share."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Camera
from lasercal_gtsam.projection import project
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate import Simulation, simulate

SIGMA_PX = 0.2
TURN_DEG, SHIFT_MM = (0.3, 0.0, 0.4), (3.0, 0.0, 4.0)


@cache
def exact() -> Simulation:
    return simulate("paper-distorted", 1)


def noisy(rng: np.random.Generator, cell: lc.Cell | None = None) -> lc.Observations:
    seen = exact().observations
    uv = seen.uv
    if cell is not None:
        names = {k: getattr(seen, k).tolist() for k in ("plane", "camera", "laser")}
        uv = project(cell, seen.T_base_hand, **names)
    return replace(seen, uv=uv + SIGMA_PX * rng.standard_normal(uv.shape))


def calibrated(seen: lc.Observations, **options: Any) -> lc.Calibration:
    options = {"robust": "none", **options}
    return lc.calibrate(seen, initial=exact().truth, options=lc.CalibrationOptions(**options))


@cache
def first() -> lc.Calibration:
    return calibrated(noisy(np.random.default_rng(101)))


@cache
def second() -> lc.Calibration:
    """The same cell, other noise."""
    return calibrated(noisy(np.random.default_rng(102)))


@cache
def camera_moved() -> lc.Calibration:
    camera = exact().truth.cameras["camera"]
    T = camera.T_base_camera
    turned = rotation_exp(np.radians(TURN_DEG)) @ T[:3, :3]
    pose = make_pose(turned, T[:3, 3] + np.array(SHIFT_MM) / 1e3)
    cell = replace(
        exact().truth, cameras={"camera": Camera(camera.intrinsics, pose, camera.image_size)}
    )
    return calibrated(noisy(np.random.default_rng(103), cell))


@cache
def fewer_spots() -> lc.Calibration:
    """A third of `first`'s spots less."""
    seen = first().inputs.observations
    return calibrated(seen[np.arange(len(seen)) % 3 > 0])
