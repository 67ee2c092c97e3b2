"""Residuals at levels: what is left when parts of the chain are let off.

Every level adds unknowns of its own to the calibration's, per spot or per group, and so stops
testing what they stand for. All the calibration's unknowns stay free at every level. A spot that is
free on its plane, alone, has as many unknowns as coordinates, and tests nothing; what is tested at
the level "picture" is therefore that the shots of one hand orientation on one plane, which the hand
only shifted, lie on the plane as the hand's positions lie in space, but for an affine map.

=======  ======================================  ==================================================
level    additional unknowns                     tested
=======  ======================================  ==================================================
picture  8 per group: affine map from hand       camera's lens, flatness of planes, hand positions
         positions to places on the plane        within a group; not: where planes are, the beam,
                                                 the robot's orientation and scale
ray      1 per spot: length along the beam       distance of beam and camera ray: camera, beam,
                                                 robot; not: planes, neither place nor flatness
hand     6 per hand orientation: its pose        camera, planes, hand positions relative to each
                                                 other; not: hand poses per orientation
full     none                                    everything
=======  ======================================  ==================================================

The residuals of a level are ``(I - H_level) e``; their expected squares are the diagonal of
``I - H_level`` times the noise. The fall from the full chain to a level is tested by F.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.opinions.bench import Bench, Index, column_space
from lasercal_gtsam.opinions.chances import f_above
from lasercal_gtsam.rotations import basis_of

PURE_DOF = 20
"""Degrees of freedom that a level must have for its residuals to stand for the noise: the noise is
then known to 16 %."""
_RANK = 1e-6


@dataclass(frozen=True)
class LevelPart:
    """Residuals of some spots at a level.

    Attributes
    ----------
    kind, name : ``camera``, ``plane`` or ``group`` (one hand orientation on one plane, by its first
        spot), and which
    spots : their number
    rms_px : root of the mean squared length
    expected_px : what the noise gives there, given that the fit has taken its share
    """

    kind: str
    name: str
    spots: int
    rms_px: float
    expected_px: float


@dataclass(frozen=True)
class Level:
    """All spots at a level.

    Attributes
    ----------
    name, frees, tests : see the module
    rms_px, expected_px : as in `LevelPart`
    dof : residuals minus unknowns
    chance : probability of so large a fall from the full chain if nothing that the level frees is
        wrong; 1 for the full chain, NaN where it cannot be tested
    parts : by camera, plane and group
    """

    name: str
    frees: str
    tests: str
    rms_px: float
    expected_px: float
    dof: int
    chance: float
    parts: tuple[LevelPart, ...]


@dataclass(frozen=True, eq=False)
class _Left:
    """What a level leaves: residuals (2 N,), and covariance of each spot's two (N, 2, 2)."""

    r: Array
    blocks: Array
    sse: float
    dof: int


_WORDS = {
    "picture": (
        "an affine map from hand positions to each group's spots",
        "the lens and the flatness of the planes",
    ),
    "ray": ("each spot's place along its beam", "camera, beam and robot, not the planes"),
    "hand": (
        "the hand's pose at each orientation",
        "camera, planes and hand positions, not orientations",
    ),
    "full": ("nothing", "everything"),
}


def levels(bench: Bench) -> tuple[Level, ...]:
    """Residuals at every level that the spots can test, the full chain last.

    The noise that ``expected_px`` follows is the stated one; or else that which is left at the
    level ``picture``, or, where that has too few spots, in the full chain.
    """
    left = {"full": _eliminate(bench, ())}
    left["picture"] = _eliminate(bench, _affine(bench))
    left["ray"] = _eliminate(bench, _along_beams(bench))
    left["hand"] = _eliminate(bench, _hand_poses(bench))
    if bench.stated:
        noise = 1.0 / bench.unit
    else:
        pure = left["picture"] if left["picture"].dof >= PURE_DOF else left["full"]
        noise = float(np.sqrt(pure.sse / max(pure.dof, 1)))
    return tuple(
        _level(bench, name, left[name], left["full"], noise)
        for name in ("picture", "ray", "hand", "full")
        if left[name].dof > 0
    )


def _level(bench: Bench, name: str, left: _Left, full: _Left, noise: float) -> Level:
    seen = bench.observations
    unwhiten = np.linalg.inv(bench.whitening)
    lengths = np.square(unwhiten @ left.r.reshape(-1, 2, 1)).sum(axis=(1, 2))
    C = unwhiten @ left.blocks @ np.swapaxes(unwhiten, 1, 2)
    expected = noise**2 * np.trace(C, axis1=1, axis2=2)

    def part(kind: str, who: str, rows: npt.NDArray[np.bool_]) -> LevelPart:
        return LevelPart(
            kind, who, int(rows.sum()), _root_mean(lengths[rows]), _root_mean(expected[rows])
        )

    parts = [part("camera", c, seen.camera == c) for c in seen.cameras]
    parts += [part("plane", p, seen.plane == p) for p in seen.planes]
    for g in range(int(bench.group.max()) + 1):
        rows = bench.group == g
        parts.append(part("group", str(seen.id[np.argmax(rows)]), rows))
    k = full.dof - left.dof
    if name == "full":
        chance = 1.0
    elif k < 1 or left.sse <= 0.0:
        chance = float("nan")
    else:
        chance = f_above(max(full.sse - left.sse, 0.0) / k / (left.sse / left.dof), k, left.dof)
    frees, tests = _WORDS[name]
    return Level(
        name,
        frees,
        tests,
        _root_mean(lengths),
        _root_mean(expected),
        left.dof,
        chance,
        tuple(parts),
    )


def _root_mean(squares: Array) -> float:
    return float(np.sqrt(max(float(np.mean(squares)), 0.0)))


def _eliminate(bench: Bench, nuisances: Iterable[tuple[Index, Array]]) -> _Left:
    """Project out unknowns of single groups of spots (rows, (len(rows), 2, k)), then all others.

    Groups share no spot, so that each is projected out within its own rows.
    """
    count = 2 * len(bench)
    A, r = bench.A.copy(), bench.r.copy()
    taken = np.zeros((len(bench), 2, 2))
    dof = len(r)
    for rows, blocks in nuisances:
        at = (2 * rows[:, None] + np.arange(2)).ravel()
        U = column_space(blocks.reshape(len(at), -1), _RANK)
        A[at] -= U @ (U.T @ A[at])
        r[at] -= U @ (U.T @ r[at])
        own = U.reshape(len(rows), 2, -1)
        taken[rows] = own @ np.swapaxes(own, 1, 2)
        dof -= U.shape[1]
    # a column that the nuisances took up is rounding: measured against what it was
    length = np.linalg.norm(bench.A, axis=0)
    kept = np.linalg.norm(A, axis=0) > _RANK * length
    Q = column_space(A[:, kept] / length[kept], _RANK)
    r -= Q @ (Q.T @ r)
    own = Q[:count].reshape(len(bench), 2, -1)
    blocks = np.eye(2) - taken - own @ np.swapaxes(own, 1, 2)
    return _Left(r[:count], blocks, float(r @ r), dof - Q.shape[1])


def _affine(bench: Bench) -> Iterable[tuple[Index, Array]]:
    seen = bench.observations
    for g in range(int(bench.group.max()) + 1):
        rows = np.flatnonzero(bench.group == g)
        E = basis_of(bench.cell.planes[str(seen.plane[rows[0]])].normal_base)
        t = seen.T_base_hand[rows, :3, 3]
        t = t - t.mean(axis=0)
        terms = np.column_stack([np.ones(len(rows)), t / (np.abs(t).max() + 1e-30)])
        place = bench.by_point[rows] @ E
        yield rows, place[:, :, :, None] * terms[:, None, None, :]


def _along_beams(bench: Bench) -> Iterable[tuple[Index, Array]]:
    seen = bench.observations
    u = np.empty((len(bench), 3))
    for name in seen.lasers:
        rows = seen.laser == name
        u[rows] = seen.T_base_hand[rows, :3, :3] @ bench.cell.lasers[name].direction_hand
    along = bench.by_point @ u[:, :, None]
    return ((np.array([k]), along[k : k + 1]) for k in range(len(bench)))


def _hand_poses(bench: Bench) -> Iterable[tuple[Index, Array]]:
    for g in range(int(bench.orientation.max()) + 1):
        rows = np.flatnonzero(bench.orientation == g)
        yield rows, bench.hand[rows]
