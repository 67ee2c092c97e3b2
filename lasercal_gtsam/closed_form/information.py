"""Whether the spots determine the cell at all: rank of the Jacobian of the residuals (55).

Structural gaps (too few hand orientations or planes, a plane parallel to the image, beams that
never change their direction) make the Jacobian singular at any state with that structure. Weak but
regular data pass: how weak they are is what the sigmas of the refinement say.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.solution import Solution, spots_on_beams
from lasercal_gtsam.closed_form.spots import Spots, pairs_of
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.rotations import basis_of, skew
from lasercal_gtsam.units import DEG_PER_RAD, RAD_PER_DEG

SMALLEST_INFORMATION = 1e-7
"""Ratio of the singular values of the column-scaled Jacobian below which it is singular."""
WORST_FOCAL_SIGMA = 3.0
"""Relative sigma beyond which a focal length counts as not given by the data."""
PARALLEL_RAD = 5.0 * RAD_PER_DEG
_SHARE = 0.01

Columns = dict[tuple[str, int], Array]
"""Name of a part and number of its parameter -> derivative of the pixels (N, 2)."""


def pixel_derivatives(solution: Solution, spots: Spots, free: tuple[str, ...]) -> Columns:
    """Derivatives of the predicted pixels of one pair, without distortion.

    Parameters
    ----------
    free : which of ``focal length, fu, fv, skew, u0, v0`` are free ("focal length" moves fu and fv
        together, with a fixed ratio)

    Returns
    -------
    The free intrinsics, "camera rotation" (3, camera axes), "camera position" (3, base axes),
    "beam direction" (2), "beam point" (2, across the beam, metres) and "plane <name>" (2 turns
    about its point, 1 shift) -> (N, 2) arrays
    """
    X, length = spots_on_beams(solution, spots)
    u = spots.R @ solution.u
    n, c = solution.normals[spots.plane], solution.points[spots.plane]
    along = (n * u).sum(-1)
    p = (X - solution.T) @ solution.R
    xy = p[:, :2] / p[:, 2:]
    per_point = np.zeros((len(X), 2, 3))
    per_point[:, :, :2] = np.eye(2)
    per_point[:, :, 2] = -xy
    per_point = (solution.K[:2, :2] @ per_point) / p[:, 2, None, None]
    per_X = per_point @ solution.R.T
    # a spot slides along its beam when the plane moves, and along the plane when the beam moves
    per_shift = (per_X @ u[:, :, None])[:, :, 0] / along[:, None]
    per_beam = per_X - per_shift[:, :, None] * n[:, None, :]
    across = per_beam @ (spots.R @ basis_of(solution.u))
    zero, one = np.zeros(len(X)), np.ones(len(X))
    aspect = solution.K[0, 0] / solution.K[1, 1]
    intrinsics = {
        "focal length": np.column_stack([aspect * xy[:, 0], xy[:, 1]]),
        "fu": np.column_stack([xy[:, 0], zero]),
        "fv": np.column_stack([zero, xy[:, 1]]),
        "skew": np.column_stack([xy[:, 1], zero]),
        "u0": np.column_stack([one, zero]),
        "v0": np.column_stack([zero, one]),
    }
    columns: Columns = {(name, 0): intrinsics[name] for name in free}
    rotation = per_point @ skew(p)
    for i in range(3):
        columns["camera rotation", i] = rotation[:, :, i]
        columns["camera position", i] = -per_X[:, :, i]
    for i in range(2):
        columns["beam direction", i] = length[:, None] * across[:, :, i]
        columns["beam point", i] = across[:, :, i]
    for k in np.unique(spots.plane):
        on = (spots.plane == k)[:, None]
        arm = (c - X) @ basis_of(solution.normals[k])
        name = f"plane {spots.plane_names[k]}"
        for i in range(2):
            columns[name, i] = np.where(on, per_shift * arm[:, i, None], 0.0)
        columns[name, 2] = np.where(on, per_shift, 0.0)
    return columns


def free_intrinsics(known: KnownIntrinsics, plane_count: int) -> tuple[str, ...]:
    """Names of the intrinsics to be found.

    With one plane the focal length only: f_u and f_v may separate so badly (normal in the camera's
    x-z or y-z plane) that the refinement needs a prior on their ratio.
    """
    free: tuple[str, ...] = ()
    if known.focal_lengths is None:
        tied = known.aspect is not None or plane_count == 1
        free += ("focal length",) if tied else ("fu", "fv")
    if plane_count > 1:
        free += ("skew",) if known.skew is None else ()
        free += ("u0", "v0") if known.principal_point is None else ()
    return free


def check_information(
    cell: Cell,
    observations: Observations,
    known: Mapping[str, KnownIntrinsics],
    rms_px: float,
) -> None:
    """Refuse a cell that the spots do not determine.

    Parameters
    ----------
    cell : complete, without distortion
    known : by camera
    rms_px : of the cell; at most 1 px of it counts as noise, the rest as a start not yet refined

    Raises
    ------
    DegenerateError
        The column-scaled Jacobian is singular: the message names the parameters that can change
        together without moving a spot, and what would tell them apart. Or a focal length would have
        a sigma of more than `WORST_FOCAL_SIGMA` times itself.
    """
    blocks: list[Columns] = []
    for camera, laser in pairs_of(observations):
        spots = Spots.of_pair(observations, camera, laser)
        seen = observations.plane[observations.camera == camera]
        free = free_intrinsics(known[camera], len(np.unique(seen)))
        columns = pixel_derivatives(Solution.of_cell(cell, spots, camera, laser), spots, free)
        blocks.append(
            {
                (_full_name(name, camera, laser, observations), i): values
                for (name, i), values in columns.items()
            }
        )
    names = sorted(set().union(*blocks))
    J = np.concatenate(
        [
            np.stack(
                [
                    block.get(name, np.zeros_like(next(iter(block.values())))).ravel()
                    for name in names
                ],
                axis=1,
            )
            for block in blocks
        ]
    )
    if not np.isfinite(J).all():
        return
    scale = np.linalg.norm(J, axis=0)
    R = np.linalg.qr(J / np.where(scale > 0, scale, 1.0), mode="r")
    _, s, Vt = np.linalg.svd(R, full_matrices=True)
    rank = int((s > SMALLEST_INFORMATION * s[0]).sum())
    if rank == len(names):
        noise = min(rms_px / np.sqrt(2.0), 1.0)
        sigmas = noise * np.sqrt(((Vt / s[:, None]) ** 2).sum(axis=0)) / scale
        _check_focal_sigmas(cell, dict(zip(names, sigmas, strict=True)))
        return
    share: dict[str, float] = {}
    for (name, _), value in zip(names, (Vt[rank:] ** 2).sum(axis=0), strict=True):
        share[name] = share.get(name, 0.0) + float(value)
    named = [name for name, value in share.items() if value > _SHARE * max(share.values())]
    raise DegenerateError(
        f"{', '.join(named)} can change {'together ' if len(named) > 1 else ''}without moving any "
        f"spot: {_remedy(cell, named)}"
    )


def _check_focal_sigmas(cell: Cell, sigmas: Mapping[tuple[str, int], float]) -> None:
    for (name, _), sigma in sigmas.items():
        parameter, _, camera = name.partition(" of ")
        if parameter in ("focal length", "fu", "fv"):
            found = cell.cameras[camera] if camera else next(iter(cell.cameras.values()))
            relative = float(sigma) / found.intrinsics.fv
            if relative > WORST_FOCAL_SIGMA:
                raise DegenerateError(
                    f"the spots give the {name} only to within {100 * relative:.0f} %: "
                    f"{_remedy(cell, [name])}"
                )


def _full_name(name: str, camera: str, laser: str, observations: Observations) -> str:
    """Name of a parameter with its owner, where there are several."""
    if name.startswith("plane"):
        return name
    if name.startswith("beam"):
        return name if len(observations.lasers) == 1 else f"{name} of {laser}"
    return name if len(observations.cameras) == 1 else f"{name} of {camera}"


def _remedy(cell: Cell, named: list[str]) -> str:
    if len(cell.planes) == 1:
        normal = next(iter(cell.planes.values())).normal_base
        for camera in cell.cameras.values():
            cosine = abs(float(normal @ camera.T_base_camera[:3, 2]))
            tilt = float(np.arccos(min(1.0, cosine)))
            if tilt < PARALLEL_RAD:
                return (
                    f"the plane is parallel to the image (to {tilt * DEG_PER_RAD:.2g} deg), where "
                    "focal length and distance look alike: tilt it by 20 deg or more, add a second "
                    "plane, or give the focal lengths"
                )
        if any(name.split(" of ")[0] in _INTRINSICS for name in named):
            return (
                "tilt the plane by 20 deg or more against the image, add a second plane, or give "
                "the focal lengths"
            )
    if any(name.split(" of ")[0] in _INTRINSICS for name in named):
        return (
            "all intrinsics need one hand orientation or more on each of three planes, or two or "
            "more on each of two planes; or say what is known (principal point, skew, aspect)"
        )
    if all(name.startswith("plane") for name in named):
        return "add spots on it, away from the line through the others"
    return (
        "turn the hand by 20 deg or more about at least two axes, so that the beam changes its "
        "direction, and translate it by several centimetres across the beam"
    )


_INTRINSICS = ("focal length", "fu", "fv", "skew", "u0", "v0")
