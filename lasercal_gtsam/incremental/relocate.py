"""One part of a cell from its spots, all else known: after a bump, or when the part is new.

A start comes in closed form from the smallest samples that give one (`part_starts`), the best of
them chosen by a robust cost on the pixels, so that a few bad spots do no harm and no guess is
needed. Least squares on the pixels with a Cauchy loss finishes (`part_fit`): errors across a beam
or a ray then count as what they are, whatever the triangulation made of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from lasercal_factors.batch import Loss

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError, DegenerateError
from lasercal_gtsam.incremental.belief import MOVABLE, Part
from lasercal_gtsam.incremental.change import TURNS, change_basis, middle_of_spots
from lasercal_gtsam.incremental.part_fit import PartFit, fit_part
from lasercal_gtsam.incremental.part_starts import (
    beams_through_two,
    cameras_from_three,
    planes_through_three,
)
from lasercal_gtsam.incremental.update import Missing
from lasercal_gtsam.observations import Observations

LOSS = Loss("cauchy", 2.385)
TURN_RANGE, SHIFT_RANGE = 0.1, 0.05
"""Plausible change of a part (rad, m): what its spots must at least say more about."""
# starts that are refined; camera poses this near each other (rad, m) lead to the same end
_REFINED: dict[Part, int] = {"camera": 3, "laser": 1, "plane": 1}
_NEAR_POSE = 0.1
# tangent coordinates of a camera with unknown intrinsics, the fullest set first, and the sigmas to
# which the spots must determine the intrinsics: fu, fv (relative), skew, u0, v0 (px), k1 k2 p1 p2
_LENSES = tuple(
    (*range(8), *rest)
    for rest in (range(8, 15), (8, 9, 10, 11, 13, 14), range(8, 12), range(8, 11), ())
)
_LENS_LIMITS = np.array([0.2, 0.2, 50.0, 100.0, 100.0, 1.0, 3.0, 0.03, 0.03])
# spots to ask for: one more than the least for a beam, so that a bad one shows; several more for a
# camera, whose pose is weak from four; with its intrinsics 24 equations for 15 unknowns
_ASKED: dict[Part, int] = {"camera": 6, "laser": 3, "plane": 3}
_ASKED_NEW_CAMERA = 12
# plausible change over sigma: below the first a part is not determined at all, from the second on
# it counts as known
_HOPELESS, _STRONG = 0.1, 5.0
# two poses are told apart when their costs differ by this (squared sigmas)
_TOLD_APART = 9.0
_SPREAD: dict[Part, str] = {
    "plane": "that are not in one line",
    "laser": "at different distances from the hand",
    "camera": "spread over the image and over its planes",
}
_WEAK: dict[Part, str] = {
    "plane": "they lie nearly on one line; add some in the other direction of the plane",
    "laser": "they lie too near each other along the beam; add some with the hand nearer to a "
    "plane, or farther away",
    "camera": "they lie too close together; add some in other parts of the image and on other "
    "planes",
}


def locate_plane(cell: Cell, observations: Observations) -> Plane:
    """Plane from three spots or more that are not in one line.

    Parameters
    ----------
    cell : has the cameras and lasers of the spots; a plane of that name is not looked at
    observations : spots on one plane; those without a covariance count with 1 px

    Raises
    ------
    DegenerateError
        The spots do not determine it; says what is missing.
    DataError
        The spots lie on several planes, or their camera or laser is not in the cell.
    """
    name = _only_name(observations, "plane")
    return _fits(cell, observations, "plane", name)[0].cell.planes[name]


def locate_laser(cell: Cell, observations: Observations) -> Beam:
    """Beam from two spots or more at different distances from the hand.

    Its point is the one nearest to the hand's origin (farther back, where a spot lies behind that).

    Parameters
    ----------
    cell : has the cameras and planes of the spots; a laser of that name is not looked at
    observations : spots of one laser; those without a covariance count with 1 px

    Raises
    ------
    DegenerateError
        The spots do not determine it; says what is missing.
    DataError
        The spots are of several lasers, or their camera or plane is not in the cell.
    """
    name = _only_name(observations, "laser")
    return _fits(cell, observations, "laser", name)[0].cell.lasers[name]


def locate_camera(
    cell: Cell, observations: Observations, intrinsics: Intrinsics | None = None
) -> Camera:
    """Camera from four spots or more: the best of `camera_candidates`."""
    return camera_candidates(cell, observations, intrinsics)[0]


def camera_candidates(
    cell: Cell, observations: Observations, intrinsics: Intrinsics | None = None
) -> tuple[Camera, ...]:
    """Cameras that explain the spots, all with the spots in front, the best first.

    There are several where few spots, or spots on one plane, fit two poses about equally well.

    Parameters
    ----------
    cell : has the lasers and planes of the spots
    observations : spots of one camera; those without a covariance count with 1 px
    intrinsics : known ones; None: those of the cell's camera of that name, and where the cell has
        none they are estimated too, which takes two planes and 8 spots or more. What the spots do
        not determine stays usual: no distortion, no skew, central principal point

    Raises
    ------
    DegenerateError
        The spots do not determine it; says what is missing.
    DataError
        The spots are of several cameras, or their laser or plane is not in the cell.
    """
    name = _only_name(observations, "camera")
    fits = _fits(cell, observations, "camera", name, intrinsics)
    return tuple(fit.cell.cameras[name] for fit in fits)


def strength(fit: PartFit, kind: Part, name: str, observations: Observations) -> float:
    """How well spots determine a part: plausible change (`TURN_RANGE`, ...) over its sigma.

    The least such ratio over all directions, by the singular values of the whitened derivative:
    below 1 the spots say less than what is plausible anyway.
    """
    rows = fit.rows[:, : 6 if kind == "camera" else None]
    if not len(rows):
        return 0.0
    middle = middle_of_spots(fit.cell, observations, name) if kind == "plane" else np.zeros(3)
    D = change_basis(fit.cell, kind, name, middle)
    ranges = np.full(len(D), SHIFT_RANGE)
    ranges[: TURNS[kind]] = TURN_RANGE
    s = np.linalg.svd(rows @ D * ranges, compute_uv=False)
    return float(s[-1]) if len(s) == len(D) else 0.0


def missing_for(
    kind: Part, name: str, observations: Observations, cell: Cell
) -> tuple[Missing, ...]:
    """What must still come before a part can be located well; empty when nothing.

    Not only a number: the spots there are must determine the part at least `_STRONG` times better
    than what is plausible anyway (`strength`), and leave one pose of a camera, not two.

    Parameters
    ----------
    kind, name : the part
    observations : any spots; those of this part count whose other parts are in the cell
    cell : what is known; a camera that is not in it needs its intrinsics too
    """
    spots = observations[getattr(observations, kind) == name]
    usable = np.ones(len(spots), dtype=np.bool_)
    for other, known in _parts(cell).items():
        if other != kind:
            usable &= np.isin(getattr(spots, other), list(known))
    have = int(usable.sum())
    asked = _ASKED[kind] if kind != "camera" or name in cell.cameras else _ASKED_NEW_CAMERA
    label = f"{kind} {name!r}"
    if have < asked:
        waiting = len(spots) - have
        more = f" ({waiting} more wait for other parts of the cell)" if waiting else ""
        words = f"{label} needs {asked} spots or more {_SPREAD[kind]}: {have} so far{more}"
        return (Missing(kind, name, have, asked, words),)
    weak = f"{label} is not determined by its {have} spots yet: "
    try:
        fits = _fits(cell, spots[usable], kind, name, None)
    except DegenerateError:
        return (Missing(kind, name, have, have + 1, weak + _WEAK[kind]),)
    if strength(fits[0], kind, name, spots[usable]) < _STRONG:
        return (Missing(kind, name, have, have + 1, weak + _WEAK[kind]),)
    if len(fits) > 1 and fits[1].cost - fits[0].cost < _TOLD_APART:
        words = f"{label}: two poses explain its {have} spots; add some on another plane"
        return (Missing(kind, name, have, have + 1, words),)
    return ()


def _fits(
    cell: Cell,
    observations: Observations,
    kind: Part,
    name: str,
    intrinsics: Intrinsics | None = None,
) -> list[PartFit]:
    """Fits of the part from the best closed-form starts, the best first, no two the same."""
    for other, known in _parts(cell).items():
        missing = [x for x in getattr(observations, f"{other}s") if x not in known]
        if missing and other != kind:
            raise DataError(
                f"{other} {missing[0]!r} has spots but is not in the cell, which has "
                f"{sorted(known)}: locate it first"
            )
    if intrinsics is None and kind == "camera" and name in cell.cameras:
        intrinsics = cell.cameras[name].intrinsics
    starts: Sequence[Plane] | Sequence[Beam] | Sequence[Camera]
    if kind == "plane":
        starts = planes_through_three(cell, observations)
    elif kind == "laser":
        starts = beams_through_two(cell, observations, name)
    else:
        starts = cameras_from_three(cell, observations, name, intrinsics)
    fits: list[PartFit] = []
    for start in starts:
        begin = _with_part(cell, kind, name, start)
        if kind == "camera" and any(_near(begin, fit.cell, name) for fit in fits):
            continue
        if kind == "camera" and intrinsics is None:
            fit = _fit_new_camera(begin, observations, name)
        else:
            fit = fit_part(begin, observations, kind, name, LOSS, range(MOVABLE[kind]))
        fits.append(fit)
        if len(fits) == _REFINED[kind]:
            break
    good = (
        f for f in fits if np.isfinite(f.cost) and strength(f, kind, name, observations) > _HOPELESS
    )
    found = sorted(good, key=lambda fit: fit.cost)
    if not found:
        raise DegenerateError(
            f"the {len(observations)} spots of {kind} {name!r} do not determine it: {_WEAK[kind]}"
        )
    if kind != "camera":
        return found[:1]
    return [
        f for i, f in enumerate(found) if not any(_near(f.cell, g.cell, name) for g in found[:i])
    ]


def _fit_new_camera(begin: Cell, observations: Observations, name: str) -> PartFit:
    """Fit as many intrinsics as the spots determine; the others stay at their usual values."""
    camera = begin.cameras[name]
    lens, size = camera.intrinsics, camera.image_size
    usual = replace(lens, skew=0.0, u0=(size[0] - 1) / 2, v0=(size[1] - 1) / 2)
    fit = PartFit(begin, np.inf, np.zeros((0, 6)))
    for coordinates in _LENSES:
        free = len(coordinates) > 8
        start = _with_part(
            begin, "camera", name, replace(camera, intrinsics=lens if free else usual)
        )
        # without distortion first: the closed form knows none
        head = [c for c in coordinates if c < 11]
        fit = fit_part(start, observations, "camera", name, LOSS, head)
        fit = fit_part(fit.cell, observations, "camera", name, LOSS, coordinates)
        if len(fit.rows) < len(coordinates) or not np.isfinite(fit.cost):
            continue
        f = fit.cell.cameras[name].intrinsics.fv
        limits = _LENS_LIMITS * np.array([f, f, 1, 1, 1, 1, 1, 1, 1])
        ranges = np.repeat([TURN_RANGE, SHIFT_RANGE], 3)
        scale = np.concatenate([ranges, limits])[list(coordinates)]
        s = np.linalg.svd(fit.rows * scale, compute_uv=False)
        if s[-1] > 1.0:
            return fit
    return replace(fit, cost=np.inf)


def _parts(cell: Cell) -> dict[Part, Mapping[str, Any]]:
    return {"camera": cell.cameras, "laser": cell.lasers, "plane": cell.planes}


def _only_name(observations: Observations, kind: Part) -> str:
    names: tuple[str, ...] = getattr(observations, f"{kind}s")
    if len(names) != 1:
        raise DataError(f"expected spots of one {kind}, got {', '.join(names) or 'no spots'}")
    return names[0]


def _with_part(cell: Cell, kind: Part, name: str, part: Any) -> Cell:
    field = f"{kind}s"
    return replace(cell, **{field: {**getattr(cell, field), name: part}})


def _near(a: Cell, b: Cell, camera: str) -> bool:
    difference = a.cameras[camera].T_base_camera - b.cameras[camera].T_base_camera
    return bool(np.abs(difference).max() < _NEAR_POSE)
