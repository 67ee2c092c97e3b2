"""Shared by the tests of the incremental package: bumps of known size, spots after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, bumps


def bumped(
    cell: lc.Cell,
    kind: str,
    name: str,
    deg: float,
    mm: float,
    rng: np.random.Generator,
    middle: np.ndarray | None = None,
) -> lc.Cell:
    """`lasercal_gtsam.simulate.bumps.bumped` in deg and mm."""
    return bumps.bumped(cell, kind, name, np.deg2rad(deg), mm * 1e-3, rng, middle)


def with_part(cell: lc.Cell, kind: str, name: str, part: object) -> lc.Cell:
    return replace(cell, **{f"{kind}s": {**getattr(cell, f"{kind}s"), name: part}})


def without_part(cell: lc.Cell, kind: str, name: str) -> lc.Cell:
    rest = {k: v for k, v in getattr(cell, f"{kind}s").items() if k != name}
    return replace(cell, **{f"{kind}s": rest})


def spots_in_turn(
    cell: lc.Cell, count: int, seed: int, pixel_px: float = 0.0, hand: Noise | None = None
) -> lc.Observations:
    """``count`` spots at arbitrary poses, cycling over the planes, all in view."""
    noise = replace(hand or Noise(), pixel_px=pixel_px)
    return bumps.spots_in_turn(cell, count, seed, noise)


def with_sigma(observations: lc.Observations, sigma_px: float) -> lc.Observations:
    cov = np.broadcast_to(sigma_px**2 * np.eye(2), (len(observations), 2, 2))
    return replace(observations, cov_uv=cov)


def outliers_among(
    observations: lc.Observations, rows: list[int], rng: np.random.Generator
) -> lc.Observations:
    """Some spots somewhere else in the image."""
    uv = observations.uv.copy()
    for row in rows:
        width, height = observations.image_size[str(observations.camera[row])]
        uv[row] = rng.uniform((0, 0), (width - 1, height - 1))
    return replace(observations, uv=uv)
