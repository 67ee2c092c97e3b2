"""Plans: the poses, what they promise, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.observability import plausible_ranges
from lasercal_gtsam.observations import Names, Observations
from lasercal_gtsam.options import DISTORTION_NAMES, LARGEST_SIGMA
from lasercal_gtsam.plan.candidates import candidate_poses
from lasercal_gtsam.plan.design import Problem, choose, covariance_of
from lasercal_gtsam.plan.limits import Limits
from lasercal_gtsam.prediction import only
from lasercal_gtsam.projection import project
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.rotations import nearest_rotation
from lasercal_gtsam.simulate.motions import MotionDesign, plan_motions
from lasercal_gtsam.simulate.streams import MOTIONS, stream

SHOTS = 10
_ROTATIONS, _SHOTS_OF_ROTATION = 4, 120
# no detector is better, and with less the prior of a few poses is lost in rounding
_SMALLEST_SIGMA_PX = 1e-3
# a direction whose variance is below this share of its coordinates' is held by a constraint
_HELD_VARIANCE = 1e-12
# the one-plane calibration holds these, as the paper does
_HELD_ON_ONE_PLANE = ("u0", "v0", "skew")


@dataclass(frozen=True, eq=False)
class Plan(FrozenData):
    """Poses to drive to, and what they promise.

    Attributes
    ----------
    cell, camera, laser : what was planned for
    T_base_hand : (N, 4, 4), metres, in an order that saves ways
    plane : (N,) name of the plane that each spot lies on
    uv : (N, 2) where it should be seen, px
    sigma_px : noise that the promise assumes
    before, after : plane -> root mean square error of `locate` over what the camera sees of it,
        metres; ``before`` is None where nothing was known but the cell's plausible ranges
    """

    cell: Cell
    camera: str
    laser: str
    T_base_hand: Array
    plane: Names
    uv: Array
    sigma_px: float
    before: Mapping[str, float] | None
    after: Mapping[str, float]

    def __len__(self) -> int:
        return len(self.plane)

    def observations(self, prefix: str = "p") -> Observations:
        """The spots as they are expected, without noise."""
        digits = max(3, len(str(len(self))))
        return Observations.from_arrays(
            self.uv,
            self.T_base_hand,
            plane=self.plane.tolist(),
            image_size=self.cell.cameras[self.camera].image_size,
            camera=self.camera,
            laser=self.laser,
            id=[f"{prefix}{k + 1:0{digits}d}" for k in range(len(self))],
        )

    def save(
        self,
        folder: str | Path,
        *,
        rotation: str,
        transform: Literal["T_base_hand", "T_hand_base"],
        length: Literal["mm", "m"],
        prefix: str = "p",
    ) -> Path:
        """Write ``poses.csv`` and a ``capture.yaml`` that waits for the pictures.

        Drive to each pose and save the picture as ``images/<id>.png``: the folder is then a
        capture, and ``lasercal calibrate`` takes it.

        Parameters
        ----------
        folder : new or empty
        rotation, transform, length : the robot's convention, as in ``capture.yaml``
        prefix : start of the ids

        Raises
        ------
        DataError
            Unknown convention, or a folder that holds something or cannot be written to.
        """
        from lasercal_gtsam.io.capture import CAPTURE_FILE
        from lasercal_gtsam.io.capture_writer import write_capture
        from lasercal_gtsam.io.files import whole_folder

        with whole_folder(folder, last=CAPTURE_FILE) as staging:
            write_capture(
                staging,
                self.observations(prefix),
                transform=transform,
                length=length,
                rotation=rotation,
                with_spots=False,
                images="images/{id}.png",
            )
        return Path(folder) / CAPTURE_FILE


def plan(
    cell: Cell,
    count: int = 40,
    *,
    camera: str | None = None,
    laser: str | None = None,
    planes: Sequence[str] | None = None,
    limits: Limits | None = None,
    distortion: bool = True,
    sigma_px: float = 1.0,
    rotations: int = _ROTATIONS,
    seed: int = 0,
) -> Plan:
    """Pick the poses that leave the least millimetre error on the working planes.

    Parameters
    ----------
    cell : known roughly, from drawings or an earlier calibration
    count : how many poses
    camera, laser : names; may be left out where the cell has one
    planes : names of those to point at, and whose error counts; None: all
    limits : of the robot; see `Limits`
    distortion : whether the lens distortion will be estimated
    sigma_px : noise of a pixel coordinate
    rotations : hand rotations to choose from on each plane
    seed : of the candidates that are drawn; the same seed gives the same plan

    Raises
    ------
    DataError
        Unknown names, a count that is not possible, or limits that leave no poses.
    """
    problem, limits = _problem(cell, camera, laser, planes, limits, distortion)
    prior = _plausible(problem)
    return _chosen(problem, limits, prior, None, count, sigma_px, rotations, seed)


def next_poses(
    calibration: Calibration,
    count: int = 1,
    *,
    camera: str | None = None,
    laser: str | None = None,
    planes: Sequence[str] | None = None,
    limits: Limits | None = None,
    rotations: int = _ROTATIONS,
    seed: int = 0,
) -> Plan:
    """Pick the next poses for a calibration that has spots already.

    What it holds fixed stays so, a known aspect ratio too; its own pixel sigma is the noise.
    Without limits the hand keeps to rotations near those that it took so far.

    Parameters
    ----------
    calibration : with a covariance
    count, camera, laser, planes, limits, rotations, seed : as in `plan`

    Raises
    ------
    DataError
        As in `plan`; or the calibration states no covariance.
    """
    cell = calibration.cell
    limits = limits or limits_of(calibration)
    problem, limits = _problem(cell, camera, laser, planes, limits, True)
    where = {label: i for i, label in enumerate(calibration.labels)}
    at = np.array([where.get(label, -1) for label in problem.labels])
    known = at >= 0
    covariance = np.zeros((len(at), len(at)))
    covariance[np.ix_(known, known)] = calibration.covariance[np.ix_(at[known], at[known])]
    if not np.isfinite(covariance).all():
        raise DataError(
            "plan: the calibration states no covariance; calibrate again with more spots first"
        )
    if not (np.diag(covariance) > 0).any():
        raise DataError("plan: the calibration holds everything fixed; there is nothing to gain")
    basis, variances = _uncertain_directions(covariance)
    problem = Problem.of(problem.cell, problem.camera, problem.laser, basis, limits)
    before = problem.mean_error(np.diag(variances))
    prior = np.diag(1.0 / variances)
    sigma_px = _pixel_sigma(calibration)
    return _chosen(problem, limits, prior, before, count, sigma_px, rotations, seed)


def procedure(
    cell: Cell,
    groups: int = 2,
    *,
    camera: str | None = None,
    laser: str | None = None,
    planes: Sequence[str] | None = None,
    limits: Limits | None = None,
    distortion: bool = True,
    sigma_px: float = 1.0,
    seed: int = 0,
) -> Plan:
    """Plan the paper's way: groups of ten translations without rotation, spots in view.

    Parameters
    ----------
    groups : hand rotations on each plane
    cell, camera, laser, planes, limits, distortion, sigma_px, seed : as in `plan`

    Raises
    ------
    DataError
        As in `plan`.
    """
    if groups < 1:
        raise DataError(f"plan: groups: expected an integer >= 1, got {groups}")
    _check_sigma(sigma_px)
    problem, limits = _problem(cell, camera, laser, planes, limits, distortion)
    design = MotionDesign(
        beam_length=limits.beam_length,
        cone=limits.cone,
        roll=limits.roll,
        depth=limits.depth,
        margin_px=limits.margin_px,
    )
    rng = stream(seed, MOTIONS)
    poses, planes = [], []
    for name, part in cell.planes.items():
        found: list[Array] = []
        for _ in range(50):
            view = cell.cameras[problem.camera], cell.lasers[problem.laser], part
            group = plan_motions(*view, 1, SHOTS, design, rng)[0]
            if limits.allow(cell, problem.camera, name, group).all():
                found.append(group)
            if len(found) == groups:
                break
        if len(found) < groups:
            raise DataError(
                f"plan: within the limits only {len(found)} of {groups} groups of {SHOTS} "
                f"translations were found on plane {name!r}; allow more reach"
            )
        poses += found
        planes += [name] * (groups * SHOTS)
    prior = _plausible(problem)
    return _made(problem, np.concatenate(poses), np.array(planes), prior, None, sigma_px)


def _problem(
    cell: Cell,
    camera: str | None,
    laser: str | None,
    planes: Sequence[str] | None,
    limits: Limits | None,
    distortion: bool,
) -> tuple[Problem, Limits]:
    limits = limits or Limits()
    seen = only(tuple(cell.cameras), camera, "camera")
    lit = only(tuple(cell.lasers), laser, "laser")
    chosen = tuple(cell.planes) if planes is None else tuple(planes)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(cell.planes):
        raise DataError(
            f"plan: planes: expected some of {', '.join(cell.planes)}, each once, got "
            f"{', '.join(map(repr, chosen)) or 'none'}"
        )
    part = Cell(
        {seen: cell.cameras[seen]},
        {lit: cell.lasers[lit]},
        {name: plane for name, plane in cell.planes.items() if name in chosen},
    )
    held = set() if distortion else set(DISTORTION_NAMES)
    held |= set(_HELD_ON_ONE_PLANE) if len(part.planes) == 1 else set()
    labels = tangent_labels(part)
    free = [label.rpartition(".")[2] not in held for label in labels]
    return Problem.of(part, seen, lit, np.eye(len(labels))[:, free], limits), limits


def _plausible(problem: Problem) -> Array:
    """Information (m, m) of a cell of which only plausible ranges are known."""
    ranges = plausible_ranges(problem.labels)
    return problem.basis.T @ np.diag(1.0 / ranges**2) @ problem.basis


def _uncertain_directions(covariance: Array) -> tuple[Array, Array]:
    """Columns (n, m) that span what is uncertain, and their variances (m,): uncorrelated.

    Coordinates that a constraint ties (f_u and f_v by a known aspect ratio) leave a direction
    without variance, which stays out.
    """
    scale = np.sqrt(np.diag(covariance))
    held = scale == 0
    scale = np.where(held, 1.0, scale)
    variances, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    uncertain = variances > _HELD_VARIANCE
    return scale[:, None] * vectors[:, uncertain], variances[uncertain]


def _check_sigma(sigma_px: float) -> None:
    if not _SMALLEST_SIGMA_PX <= sigma_px <= LARGEST_SIGMA:  # nor NaN
        raise DataError(
            f"plan: sigma_px: expected pixels from {_SMALLEST_SIGMA_PX:g} to {LARGEST_SIGMA:g}, "
            f"got {sigma_px!r}"
        )


def _chosen(
    problem: Problem,
    limits: Limits,
    prior: Array,
    before: Mapping[str, float] | None,
    count: int,
    sigma_px: float,
    rotations: int,
    seed: int,
) -> Plan:
    for what, value in (("count", count), ("rotations", rotations)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise DataError(f"plan: {what}: expected an integer >= 1, got {value!r}")
    _check_sigma(sigma_px)
    T, planes = candidate_poses(
        problem.cell,
        problem.camera,
        problem.laser,
        rotations,
        _SHOTS_OF_ROTATION,
        limits,
        stream(seed, MOTIONS),
    )
    rows = problem.rows(T, planes)
    chosen = choose(prior, rows, problem.weight, sigma_px, count)
    return _made(problem, T[chosen], planes[chosen], prior, before, sigma_px)


def _made(
    problem: Problem,
    T: Array,
    plane: Names,
    prior: Array,
    before: Mapping[str, float] | None,
    sigma_px: float,
) -> Plan:
    order = _short_way(T, plane)
    T, plane = T[order], plane[order]
    after = covariance_of(prior, problem.rows(T, plane), sigma_px)
    uv = project(problem.cell, T, plane=plane.tolist(), camera=problem.camera, laser=problem.laser)
    return Plan(
        problem.cell,
        problem.camera,
        problem.laser,
        T,
        plane,
        uv,
        sigma_px,
        before,
        problem.mean_error(after),
    )


def _short_way(T: Array, plane: Names) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Plane by plane, rotation by rotation, and there always to the nearest pose."""
    order: list[int] = []
    rest = list(range(len(T)))
    while rest:
        here = order[-1] if order else rest[0]
        key = [
            (
                plane[k] != plane[here],
                not np.array_equal(T[k, :3, :3], T[here, :3, :3]),
                float(np.linalg.norm(T[k, :3, 3] - T[here, :3, 3])),
            )
            for k in rest
        ]
        order.append(rest.pop(min(range(len(rest)), key=key.__getitem__)))
    return np.array(order, dtype=np.int64)


def limits_of(calibration: Calibration) -> Limits:
    """Limits out of what the hand did so far: its mean rotation, and how long the beam was."""
    from lasercal_gtsam.projection import beam_in_base, beam_plane_distance

    seen = calibration.inputs.observations
    if not len(seen):
        return Limits()
    cell = calibration.cell
    posture = nearest_rotation(seen.T_base_hand[:, :3, :3].sum(axis=0))
    lengths = []
    for laser in cell.lasers:
        for name, part in cell.planes.items():
            on = (seen.plane == name) & (seen.laser == laser)
            u, q = beam_in_base(seen.T_base_hand[on], cell.lasers[laser])
            lengths.append(beam_plane_distance(u, q, part.normal_base, part.distance))
    length = np.concatenate(lengths)
    length = length[np.isfinite(length) & (length > 0)]
    if not len(length):
        return Limits(posture=posture)
    return Limits(posture=posture, beam_length=(float(length.min()), float(length.max())))


def _pixel_sigma(calibration: Calibration) -> float:
    """Sigma of a pixel coordinate in the calibration, px."""
    cov = calibration.inputs.observations.cov_uv
    stated = np.sqrt(np.nanmedian(cov[:, [0, 1], [0, 1]])) if np.isfinite(cov).any() else np.nan
    given = calibration.inputs.options.sigma_px
    if np.isfinite(stated):
        return float(stated)
    return float(given if given is not None else max(calibration.fit.sigma0, 1e-3))
