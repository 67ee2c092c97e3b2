"""Shared by the tests of `watch` and `update`: a stream of spots, and captures that hold parts."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.simulate import Noise, simulate

# so many that the calibrator does not search for another start any more
START = 300
OPTIONS = lc.CalibrationOptions(sigma_px=1.0, known={"skew": 0})


@cache
def truth() -> lc.Cell:
    return simulate("paper-2", 3, Noise(pixel_px=1.0), shots=70).truth


@cache
def stream() -> lc.Observations:
    """420 spots on two planes in mixed order, 1 px."""
    seen = simulate("paper-2", 3, Noise(pixel_px=1.0), shots=70).observations
    order = np.random.default_rng(8).permutation(len(seen))
    return named(seen[order], "s")


def named(seen: lc.Observations, letter: str) -> lc.Observations:
    fields = {n: getattr(seen, n) for n in seen.__dataclass_fields__}
    return lc.Observations(**{**fields, "id": [f"{letter}{k:03d}" for k in range(len(seen))]})


@cache
def start() -> lc.Calibration:
    """From the first 300 spots."""
    return lc.calibrate(stream()[:START], initial=truth(), options=OPTIONS)


def bumped(seen: lc.Observations, mm: float = 10.0, deg: float = 2.0) -> lc.Observations:
    """The same poses after somebody has run into the camera."""
    camera = truth().cameras["camera"]
    angle = np.deg2rad(deg)
    c, s = np.cos(angle), np.sin(angle)
    move = make_pose(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), [mm * 1e-3, 0, 0])
    moved = lc.Camera(camera.intrinsics, camera.T_base_camera @ move, camera.image_size)
    cell = lc.Cell({"camera": moved}, truth().lasers, truth().planes)
    rng = np.random.default_rng(4)
    uv = np.array(
        [
            lc.project(cell, T[None], plane=plane)[0]
            for T, plane in zip(seen.T_base_hand, seen.plane.tolist(), strict=True)
        ]
    ) + rng.normal(0, 1, (len(seen), 2))
    width, height = camera.image_size
    inside = ((uv > 0) & (uv < [width - 1, height - 1])).all(axis=1)
    fields = {n: getattr(seen, n) for n in seen.__dataclass_fields__}
    return lc.Observations(**{**fields, "uv": uv})[inside]


def capture_of(folder: Path, seen: lc.Observations, **options) -> Path:
    """A capture on disk; returns its folder."""
    write_capture(
        folder,
        seen,
        transform=options.pop("transform", "T_base_hand"),
        length="mm",
        rotation=options.pop("rotation", "quat_wxyz"),
        with_spots=True,
        noise={"pixel": 1.0},
        known={"skew": 0},
        **options,
    )
    return folder


def lines_of(folder: Path) -> list[bytes]:
    """Header and rows of poses.csv, with their ends."""
    return (folder / "poses.csv").read_bytes().splitlines(keepends=True)


def differences(a: lc.Calibration, b: lc.Calibration) -> float:
    """Largest difference of a parameter or sigma, in sigmas."""
    assert [p.name for p in a.parameters] == [p.name for p in b.parameters]
    free = [(p, q) for p, q in zip(a.parameters, b.parameters, strict=True) if p.sigma > 0]
    assert free
    return max(max(abs(p.refined - q.refined), abs(p.sigma - q.sigma)) / p.sigma for p, q in free)
