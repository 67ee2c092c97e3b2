"""Which part of the cell is to blame: a score test of each fault against the residuals.

A fault that shifts the pixels by ``B x`` (k unknown amounts ``x``) takes the sum of squares down by
``gain = |P r|^2``, ``P`` the projector on ``(I - H) B``. Without the fault
``(gain / k) / ((SSE - gain) / (dof - k))`` has the F distribution with k and dof - k degrees of
freedom, whatever the noise's size. Among the faults that are significant, the one with the best
Bayesian information criterion is named: it explains most for the unknowns it takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.opinions.bench import BEAM, CAMERA, PLANE, Bench, Index
from lasercal_gtsam.opinions.chances import f_above
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.units import MM_PER_M

Part = Literal["camera", "laser", "plane", "robot"]
FAULT_CHANCE = 1e-4
"""Chance of naming any fault in a good calibration (all suspects together): a cell is calibrated
many times in its life, and a wrong accusation sends somebody looking for nothing."""
RIVAL_SCORE = 6.0
"""Difference of the criterion up to which two faults are not told apart ("positive" evidence at
most; Kass and Raftery, 1995)."""
# moments at which something may have moved: so many, evenly, if there are more
_MOST_MOMENTS = 12
# share of a column that must be left by the projection for its amount to be tested: what the
# calibration takes up to first order leaves such a share by the curvature of the model
_VISIBLE = 1e-3


@dataclass(frozen=True)
class Suspect:
    """A fault that might be, with the k columns (2 N + P, k) by which it would show.

    ``has_shift``: the first column is per metre of a shift along a plane's normal.
    """

    part: Part
    name: str
    fault: str
    words: str
    columns: Array
    has_shift: bool = False


@dataclass(frozen=True)
class Finding:
    """What the residuals say of a suspect.

    Attributes
    ----------
    part, name, fault, words : the suspect
    chance : probability of so large a gain without the fault, times the number of suspects
    unknowns : how many amounts the fault has that the calibration does not take up
    shrink : noise with the fault admitted over noise without: 1 explains nothing
    score : difference of the Bayesian information criterion; positive speaks for the fault
    shift_mm : how far a plane moved along its normal; None for other faults
    """

    part: Part
    name: str
    fault: str
    words: str
    chance: float
    unknowns: int
    shrink: float
    score: float
    shift_mm: float | None = None

    @property
    def significant(self) -> bool:
        """Whether noise alone hardly explains it."""
        return self.chance < FAULT_CHANCE


def accuse(bench: Bench) -> tuple[Finding, ...]:
    """Test every suspect; the significant ones first, by their score, then the others."""
    tried = list(suspects(bench))
    found = [
        finding for suspect in tried if (finding := _try(bench, suspect, len(tried))) is not None
    ]
    return tuple(sorted(found, key=lambda f: (not f.significant, -f.score)))


def culprit(findings: tuple[Finding, ...]) -> Finding | None:
    """The suspect to name: the first, if it is significant and worth its unknowns."""
    first = findings[0] if findings else None
    return first if first is not None and first.significant and first.score > 0 else None


def rivals(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """The best fault of each other kind that explains the residuals nearly as well as the first."""
    named = culprit(findings)
    if named is None:
        return ()
    kinds = {(named.part, named.fault): named}
    for finding in findings[1:]:
        if finding.significant and finding.score > named.score - RIVAL_SCORE:
            kinds.setdefault((finding.part, finding.fault), finding)
    return tuple(kinds.values())[1:]


def gain_of(bench: Bench, columns: Array) -> tuple[float, int]:
    """Fall of the sum of squares with these columns (2 N + P, k) admitted, and their rank."""
    length = np.linalg.norm(columns, axis=0)
    columns = columns[:, length > 0] / length[length > 0]
    if not columns.size:
        return 0.0, 0
    left = columns - bench.Q @ (bench.Q.T @ columns)
    U, s, _ = np.linalg.svd(left, full_matrices=False)
    U = U[:, s > _VISIBLE]
    return float(np.sum((U.T @ bench.residuals) ** 2)), int(U.shape[1])


def _try(bench: Bench, suspect: Suspect, count: int) -> Finding | None:
    gain, k = gain_of(bench, suspect.columns)
    rest = bench.dof - k
    if k == 0 or rest < 1:
        return None
    left = max(bench.sse - gain, 1e-12 * bench.sse)
    n = 2 * len(bench)
    return Finding(
        suspect.part,
        suspect.name,
        suspect.fault,
        suspect.words,
        min(1.0, count * f_above((gain / k) / (left / rest), k, rest)),
        k,
        float(np.sqrt((left / rest) / (bench.sse / bench.dof))),
        float(n * np.log(bench.sse / left) - k * np.log(n)),
        _shift_mm(bench, suspect),
    )


def _shift_mm(bench: Bench, suspect: Suspect) -> float | None:
    if not suspect.has_shift:
        return None
    left = suspect.columns - bench.Q @ (bench.Q.T @ suspect.columns)
    # residuals are predicted minus seen: the fault is what would take them away
    return float(-np.linalg.lstsq(left, bench.residuals, rcond=_VISIBLE)[0][0] * MM_PER_M)


def suspects(bench: Bench) -> Iterator[Suspect]:
    """All faults that are looked for."""
    seen = bench.observations
    for name in seen.cameras:
        rows = np.flatnonzero(seen.camera == name)
        yield from _lens(bench, name, rows)
        yield from _moved(bench, "camera", name, rows, bench.parts[:, :, CAMERA][:, :, :6])
    for name in seen.lasers:
        rows = np.flatnonzero(seen.laser == name)
        yield from _moved(bench, "laser", name, rows, bench.parts[:, :, BEAM])
    for name in seen.planes:
        rows = np.flatnonzero(seen.plane == name)
        yield _bent(bench, name, rows)
        shift = bench.parts[:, :, PLANE][:, :, 2:]
        yield from _moved(bench, "plane", name, rows, shift)
        tilts = _tilts(bench, name, rows)
        yield from _moved(bench, "plane", name, rows, np.concatenate([shift, tilts], axis=2))
    yield from _robot(bench)


def _masked(bench: Bench, blocks: Array, rows: Index) -> Array:
    out = np.zeros_like(blocks)
    out[rows] = blocks[rows]
    return bench.columns(out)


def _moved(bench: Bench, part: Part, name: str, rows: Index, blocks: Array) -> Iterator[Suspect]:
    """The part was elsewhere from some spot on (spots in the order they were given)."""
    groups = bench.group[rows]
    starts = np.flatnonzero(groups[1:] != groups[:-1]) + 1
    if len(starts) > _MOST_MOMENTS:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST_MOMENTS).round().astype(int)]
    for first in starts:
        spot = bench.observations.id[rows[first]]
        words = f"{part} {name!r} moved before spot {str(spot)!r}"
        columns = _masked(bench, blocks, rows[first:])
        yield Suspect(part, name, "moved", words, columns, has_shift=part == "plane")


def _lens(bench: Bench, name: str, rows: Index) -> Iterator[Suspect]:
    """Distortion terms, held ones and ``r^6`` too; then any smooth field over the picture."""
    camera = bench.cell.cameras[name]
    R, t = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    p = (bench.points[rows] - t) @ R
    xy = p[:, :2] / p[:, 2:]
    i = camera.intrinsics
    to_pixel = bench.whitening[rows] @ np.array([[i.fu, i.skew], [0.0, i.fv]])
    # powers of a coordinate of about one
    z = xy / np.sqrt(np.mean(np.sum(xy**2, axis=1)))
    r2 = np.sum(z**2, axis=1, keepdims=True)
    x, y = z.T
    decentred = [
        np.column_stack([2 * x * y, r2[:, 0] + 2 * y * y]),
        np.column_stack([r2[:, 0] + 2 * x * x, 2 * x * y]),
    ]
    terms = np.stack([z * r2, z * r2**2, z * r2**3, *decentred], axis=2)
    blocks = np.zeros((len(bench), 2, terms.shape[2]))
    blocks[rows] = to_pixel @ terms
    words = f"the lens of camera {name!r} bends rays otherwise than the model does"
    yield Suspect(
        "camera", name, "lens", f"{words} (radially, or decentred)", bench.columns(blocks)
    )
    powers = [z[:, 0] ** a * z[:, 1] ** b for a in range(4) for b in range(4 - a) if a + b >= 2]
    field = np.stack(powers, axis=1)[:, None, None, :]
    blocks = np.zeros((len(bench), 2, 2 * len(powers)))
    blocks[rows] = (to_pixel[:, :, :, None] * field).reshape(len(rows), 2, -1)
    yield Suspect("camera", name, "lens", f"{words} (otherwise)", bench.columns(blocks))


def _bent(bench: Bench, name: str, rows: Index) -> Suspect:
    """Height above the plane quadratic in the place on it."""
    x, y = _on_plane(bench, name, rows).T
    height = np.zeros((len(bench), 1, 3))
    height[rows, 0] = np.column_stack([x * x, x * y, y * y])
    blocks = bench.parts[:, :, PLANE][:, :, 2:] * height
    return Suspect("plane", name, "bent", f"plane {name!r} is not flat", bench.columns(blocks))


def _tilts(bench: Bench, name: str, rows: Index) -> Array:
    """(N, 2, 2) tilts of the plane about the middle of its spots."""
    height = np.zeros((len(bench), 1, 2))
    height[rows, 0] = _on_plane(bench, name, rows)
    return bench.parts[:, :, PLANE][:, :, 2:] * height


def _on_plane(bench: Bench, name: str, rows: Index) -> Array:
    """(len(rows), 2) places on the plane about their middle, of mean square one."""
    E = basis_of(bench.cell.planes[name].normal_base)
    xy = (bench.points[rows] - bench.points[rows].mean(axis=0)) @ E
    return np.asarray(xy / np.sqrt(np.mean(np.sum(xy**2, axis=1)) + 1e-30))


def _robot(bench: Bench) -> Iterator[Suspect]:
    """Hand positions stretched, a joint off, or hand poses that are wrong at orientations."""
    T = bench.observations.T_base_hand
    t, R = T[:, :3, 3], T[:, :3, :3]
    shift, turn = bench.hand[:, :, :3], bench.hand[:, :, 3:]
    scaled = shift[:, :, :, None] * (t / np.abs(t).max())[:, None, None, :]
    stretch = np.einsum("nkii->nki", scaled)
    yield Suspect(
        "robot",
        "scale",
        "scale",
        "the robot's distances are not the same in all directions",
        bench.columns(stretch),
    )
    # turned about a horizontal axis across one of the hand's own axes: what a wrist joint does. The
    # joint's axis passes the hand's origin at some place in the hand
    for axis, own in zip("xyz", np.moveaxis(R, 2, 0), strict=True):
        turned = np.einsum("nji,nj->ni", R, np.cross([0.0, 0.0, 1.0], own))
        lever = [np.cross(e, turned)[:, :, None] for e in np.eye(3)]
        yield Suspect(
            "robot",
            f"joint across {axis}",
            "orientation",
            "hand poses are wrong in a way that goes with the hand's orientation, as if the zero "
            f"of a joint across the hand's {axis} axis were off",
            bench.columns(
                np.concatenate([turn @ turned[:, :, None], *(shift @ R @ x for x in lever)], axis=2)
            ),
        )
    labels, counts = np.unique(bench.orientation, return_counts=True)
    several = labels[counts >= 4] if len(labels) <= 40 else labels[:0]
    whole = []
    for g in several:
        rows = np.flatnonzero(bench.orientation == g)
        # a pose that the spots of one orientation share: position, and turn about their middle
        blocks = np.zeros((len(bench), 2, 6))
        blocks[rows] = bench.hand[rows]
        first = str(bench.observations.id[rows[0]])
        yield Suspect(
            "robot",
            f"orientation of {first}",
            "orientation",
            f"the hand's pose is wrong at the {len(rows)} spots of the orientation of {first!r}",
            bench.columns(blocks),
        )
        whole.append(blocks[:, :, 3:])
    if len(whole) > 1:
        yield Suspect(
            "robot",
            "orientations",
            "orientation",
            "the hand's turn is wrong by another amount at every orientation",
            bench.columns(np.concatenate(whole, axis=2)),
        )
