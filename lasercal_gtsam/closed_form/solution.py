"""One (camera, laser) pair solved in closed form, and how well it explains its spots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.closed_form.spots import Spots, pairs_of
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.rotations import make_pose, nearest_rotation

NEGATIVE_DEPTH_PENALTY_PX = 1000.0


@dataclass(frozen=True, eq=False)
class Solution:
    """Camera, beam and planes of one pair; planes that could not be solved are NaN.

    Attributes
    ----------
    K : (3, 3) camera matrix for pixels (not scaled ones)
    R, T : (3, 3), (3,) camera pose ``p_base = R p_camera + T``, metres
    u, q : (3,), (3,) direction and point of the beam in the hand frame, metres
    normals, points : (P, 3), (P, 3) of the planes in the base, metres
    """

    K: Array
    R: Array
    T: Array
    u: Array
    q: Array
    normals: Array
    points: Array

    @classmethod
    def of_cell(cls, cell: Cell, spots: Spots, camera: str, laser: str) -> Solution:
        """The pair's part of a cell, without its distortion."""
        pose, beam = cell.cameras[camera].T_base_camera, cell.lasers[laser]
        planes = [cell.planes[name] for name in spots.plane_names]
        return cls(
            K=cell.cameras[camera].intrinsics.K,
            R=pose[:3, :3],
            T=pose[:3, 3],
            u=beam.direction_hand,
            q=beam.point_hand,
            normals=np.array([plane.normal_base for plane in planes]),
            points=np.array([plane.vector for plane in planes]),
        )

    def to_cell(self, spots: Spots, camera: str, laser: str) -> Cell:
        """Named form without distortion; planes that are NaN are left out."""
        K = self.K
        intrinsics = Intrinsics(fu=K[0, 0], fv=K[1, 1], skew=K[0, 1], u0=K[0, 2], v0=K[1, 2])
        planes = {
            name: Plane.from_point(normal, point)
            for name, normal, point in zip(
                spots.plane_names, self.normals, self.points, strict=True
            )
            if np.isfinite(normal).all()
        }
        pose = make_pose(nearest_rotation(self.R), self.T)
        return Cell(
            {camera: Camera(intrinsics, pose, spots.image_size)},
            {laser: Beam(self.u, self.q)},
            planes,
        )


def beam_towards_spots(solution: Solution, spots: Spots) -> Solution:
    """Choose the beam's sign so that it runs from the hand to the spots, and its point behind them.

    No equation tells ``u`` from ``-u``. The point is the one nearest to the hand's origin; where
    spots lie on both sides of it (rare), it is moved back along the beam behind all of them.
    """
    u = solution.u
    q = solution.q - (solution.q @ u) * u
    _, along = spots_on_beams(replace(solution, u=u, q=q), spots)
    along = along[np.isfinite(along)]
    if not len(along):
        return replace(solution, q=q)
    if np.median(along) < 0:
        u, along = -u, -along
    nearest, farthest = along.min(), along.max()
    if nearest <= 0:
        q = q + (nearest - 0.1 * (farthest - nearest)) * u
    return replace(solution, u=u, q=q)


def spots_on_beams(solution: Solution, spots: Spots) -> tuple[Array, Array]:
    """Where the beams meet the planes (N, 3) in the base, and how far along, corrected (8), (9).

    NaN on planes that are not solved; a length is negative where the plane lies behind ``q``.
    """
    n, c = solution.normals[spots.plane], solution.points[spots.plane]
    u, q = spots.R @ solution.u, spots.R @ solution.q + spots.t
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (n * (c - q)).sum(-1) / (n * u).sum(-1)
        return q + length[:, None] * u, np.asarray(length)


def spot_distances(solution: Solution, spots: Spots) -> Array:
    """Distance of every spot from its prediction: (N,) pixels.

    Infinite behind the camera or the beam, NaN on planes that are not solved.
    """
    error, behind = _pixel_errors(solution, spots)
    distance = np.sqrt((error**2).sum(axis=1))
    unsolved = ~np.isfinite(solution.normals[spots.plane]).all(axis=1)
    return np.where(unsolved, np.nan, np.where(behind | np.isnan(distance), np.inf, distance))


def reprojection(solution: Solution, spots: Spots) -> tuple[float, float]:
    """Root mean square distance in pixels and fraction of spots behind camera or beam.

    Spots on unsolved planes do not count. A spot behind the camera is projected all the same, so
    that the first number stays comparable.
    """
    error, behind = _pixel_errors(solution, spots)
    counted = np.isfinite(solution.normals[spots.plane]).all(axis=1)
    if not counted.any():
        return np.inf, 1.0
    mean = (error[counted] ** 2).sum(axis=1).mean()
    return float(np.sqrt(mean)) if np.isfinite(mean) else np.inf, float(behind[counted].mean())


def _pixel_errors(solution: Solution, spots: Spots) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Predicted minus seen pixels (N, 2), and which spots lie behind camera or beam (N,)."""
    X, length = spots_on_beams(solution, spots)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        p = (X - solution.T) @ solution.R
        image = p @ (spots.scaling @ solution.K).T
        error = (image[:, :2] / image[:, 2:] - spots.xy) / spots.scaling[0, 0]
    return np.asarray(error), ~((p[:, 2] > 0) & (length > 0))


def cell_reprojection(cell: Cell, observations: Observations) -> tuple[float, float]:
    """`reprojection` over all pairs of a capture; the cell must have all their parts."""
    squared = behind = 0.0
    for camera, laser in pairs_of(observations):
        spots = Spots.of_pair(observations, camera, laser)
        rms, negative = reprojection(Solution.of_cell(cell, spots, camera, laser), spots)
        squared += len(spots) * rms**2
        behind += len(spots) * negative
    return float(np.sqrt(squared / len(observations))), behind / len(observations)
