"""Planes that too few agreeing shots could give, found once camera and beam are known.

Camera ray and beam of a spot must meet, which tells outliers on any plane; where they do is a point
of the plane. Three of them fix it, and random threes find the plane that most spots fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lasercal_gtsam.closed_form.solution import Solution, spot_distances
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.closed_form.triangulation import fit_plane
from lasercal_gtsam.frozen import Array

_TRIALS = 150
# spots that must be near a plane, one more than fix it
_FEWEST = 5


def with_lost_planes(solution: Solution, spots: Spots, limit_px: float) -> Solution:
    """The solution with its unsolved planes found from all their spots, where enough agree."""
    lost = np.flatnonzero(~np.isfinite(solution.normals).all(axis=1))
    if not len(lost):
        return solution
    normals, points = solution.normals.copy(), solution.points.copy()
    for p in lost:
        found = _plane(solution, spots.subset(spots.on_plane(int(p))), limit_px)
        if found is not None:
            normals[p], points[p] = found
    return replace(solution, normals=normals, points=points)


def _plane(solution: Solution, spots: Spots, limit_px: float) -> tuple[Array, Array] | None:
    X, good = points_on_beams(solution, spots, limit_px)
    X = X[good]
    if len(X) < _FEWEST:
        return None
    rng = np.random.default_rng(len(X))
    best, near = 0.0, np.zeros(len(spots), dtype=bool)
    threes = np.argsort(rng.random((_TRIALS, len(X))), axis=1)[:, :3]
    for a, b, c in X[threes]:
        distances = _distances(solution, spots, np.cross(b - a, c - a), a)
        gain = float(np.maximum(0.0, 1.0 - (distances / limit_px) ** 2).sum())
        if gain > best:
            best, near = gain, distances < limit_px
    chosen = X[near[good]]
    return fit_plane(chosen) if near.sum() >= _FEWEST and len(chosen) >= 3 else None


def points_on_beams(solution: Solution, spots: Spots, limit_px: float) -> tuple[Array, Array]:
    """Points of the beams nearest to the camera rays, (N, 3) metres, and whether the two meet.

    They do where the point is seen within the limit of the spot, before the camera and the beam.
    """
    u, q = spots.R @ solution.u, spots.R @ solution.q + spots.t
    m = np.concatenate([spots.xy, np.ones((len(spots), 1))], axis=1)
    rays = np.linalg.solve(spots.scaling @ solution.K, m.T).T @ solution.R.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    w = q - solution.T
    cos = (u * rays).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (cos * (w * rays).sum(axis=1) - (w * u).sum(axis=1)) / (1.0 - cos * cos)
        X = q + along[:, None] * u
        p = (X - solution.T) @ solution.R @ (spots.scaling @ solution.K).T
        error = np.linalg.norm(p[:, :2] / p[:, 2:] - spots.xy, axis=1) / spots.scaling[0, 0]
        return X, (error < limit_px) & (p[:, 2] > 0) & (along > 0)


def _distances(solution: Solution, spots: Spots, normal: Array, point: Array) -> Array:
    """`solution.spot_distances` of spots of one plane for a trial plane; infinite where none."""
    count = spots.plane_count
    trial = replace(
        solution, normals=np.tile(normal, (count, 1)), points=np.tile(point, (count, 1))
    )
    return np.nan_to_num(spot_distances(trial, spots), nan=np.inf, posinf=np.inf)
