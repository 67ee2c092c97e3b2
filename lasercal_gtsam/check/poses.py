"""What the hand poses of a capture say, before any spot is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.groups import (
    GROUP_TOLERANCE_RAD,
    SMALLEST_GROUP,
    group_labels,
)
from lasercal_gtsam.closed_form.requirements import (
    DISTINCT_ORIENTATION_RAD,
    check_orientations,
    check_translations,
    spots_needed,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.conventions import rotvec_from_matrix
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.observations import Index, Names
from lasercal_gtsam.rotations import nearest_rotation
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

SMALL_TURN_DEG = 5.0
"""Rms turn about the second axis below which the camera's place comes out several times worse."""
SHORT_TRANSLATION_MM = 40.0
"""Longest translation of a group below which the closed form comes out ten times worse."""
ADVISABLE_SPOTS = 30
_SAME_POSE = 1e-6


@dataclass(frozen=True)
class Turns:
    """How the hand's orientations differ.

    Attributes
    ----------
    distinct : orientations that differ by more than 0.5 deg
    rms_deg : rms turn about the three main axes (in the hand), largest first
    largest_deg : largest angle of an orientation to the mean one
    """

    distinct: int
    rms_deg: tuple[float, float, float]
    largest_deg: float

    @classmethod
    def of(cls, R: Array) -> Turns:
        """Turns of orientations (N, 3, 3) about their mean."""
        mean = nearest_rotation(R.mean(axis=0))
        turns = rotvec_from_matrix(mean.T @ R) * DEG_PER_RAD
        rms = np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(R))[::-1], 0.0))
        one_plane = np.zeros(len(R), dtype=np.int64)
        distinct = int(group_labels(R, one_plane, DISTINCT_ORIENTATION_RAD).max()) + 1
        largest = float(np.linalg.norm(turns, axis=1).max())
        return cls(distinct, (float(rms[0]), float(rms[1]), float(rms[2])), largest)

    @property
    def axes(self) -> int:
        """About how many axes the hand turns by a useful angle."""
        return sum(rms >= SMALL_TURN_DEG for rms in self.rms_deg)


@dataclass(frozen=True)
class PlaneShots:
    """The shots on one plane.

    Attributes
    ----------
    plane : its name
    rows : number of shots
    groups : number of groups of four or more shots that share a hand orientation
    orientations : distinct hand orientations
    in_groups : number of shots in these groups
    longest_mm : longest distance between two shots of a group, the median over the groups; 0
        without groups
    """

    plane: str
    rows: int
    groups: int
    orientations: int
    in_groups: int
    longest_mm: float


@dataclass(frozen=True)
class PoseFacts:
    """What the poses of a capture say.

    Attributes
    ----------
    rows : number of shots
    counts : ``camera``, ``plane``, ``laser`` -> name -> number of shots
    turns : of all shots
    planes : one for each plane
    extent_mm : size of the box of the hand's positions along the base axes
    reach_mm : largest distance of the hand from the base
    missing : what makes a calibration impossible, one sentence each; empty if nothing does
    advice : what would make it poor, one sentence each
    odd : what looks like a slip, one sentence each
    """

    rows: int
    counts: dict[str, dict[str, int]]
    turns: Turns
    planes: tuple[PlaneShots, ...]
    extent_mm: tuple[float, float, float]
    reach_mm: float
    missing: tuple[str, ...]
    advice: tuple[str, ...]
    odd: tuple[str, ...]


def pose_facts(
    T_base_hand: Array,
    planes: Names,
    cameras: Names,
    lasers: Names,
    ids: Sequence[str],
    group_tolerance_rad: float = GROUP_TOLERANCE_RAD,
) -> PoseFacts:
    """Look at N hand poses (N, 4, 4), metres, with their (N,) names and labels.

    ``group_tolerance_rad`` is the largest angle within a group of pure translations.
    """
    R, t = T_base_hand[:, :3, :3], T_base_hand[:, :3, 3]
    names, plane_index = np.unique(planes, return_inverse=True)
    labels = group_labels(R, plane_index, group_tolerance_rad)
    shots = tuple(
        _plane_shots(str(name), R[plane_index == p], t[plane_index == p], labels[plane_index == p])
        for p, name in enumerate(names)
    )
    turns = Turns.of(R)
    extent = np.ptp(t, axis=0) * MM_PER_M
    return PoseFacts(
        rows=len(t),
        counts={
            kind: {str(name): int((values == name).sum()) for name in np.unique(values)}
            for kind, values in (("camera", cameras), ("plane", planes), ("laser", lasers))
        },
        turns=turns,
        planes=shots,
        extent_mm=(float(extent[0]), float(extent[1]), float(extent[2])),
        reach_mm=float(np.linalg.norm(t, axis=1).max()) * MM_PER_M,
        missing=tuple(_missing(R, t, planes, cameras, lasers)),
        advice=tuple(_advice(turns, shots)),
        odd=tuple(_repeated(T_base_hand, planes, cameras, lasers, ids)),
    )


def _plane_shots(name: str, R: Array, t: Array, labels: Index) -> PlaneShots:
    found, sizes = np.unique(labels, return_counts=True)
    lengths = []
    for group in found[sizes >= SMALLEST_GROUP]:
        positions = t[labels == group]
        lengths.append(float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()))
    one_plane = np.zeros(len(R), dtype=np.int64)
    return PlaneShots(
        plane=name,
        rows=len(t),
        groups=len(lengths),
        orientations=int(group_labels(R, one_plane, DISTINCT_ORIENTATION_RAD).max()) + 1,
        in_groups=int(sizes[sizes >= SMALLEST_GROUP].sum()),
        longest_mm=float(np.median(lengths)) * MM_PER_M if lengths else 0.0,
    )


def _missing(R: Array, t: Array, planes: Names, cameras: Names, lasers: Names) -> list[str]:
    """Why no camera with its laser can be solved; empty if one can."""
    found: list[str] = []
    for camera in np.unique(cameras):
        for laser in np.unique(lasers[cameras == camera]):
            rows = (cameras == camera) & (lasers == laser)
            try:
                _check_pair(R[rows], t[rows], len(np.unique(planes[rows])))
            except DegenerateError as error:
                who = "" if rows.all() else f"camera {str(camera)!r} with laser {str(laser)!r}: "
                found.append(f"{who}{error}")
                continue
            return []
    return found


def _check_pair(R: Array, t: Array, plane_count: int) -> None:
    needed = spots_needed(plane_count)
    if len(t) < needed:
        raise DegenerateError(
            f"{len(t)} shots on {plane_count} plane{'s' if plane_count > 1 else ''} are too few: "
            f"at least {needed} are needed, and {ADVISABLE_SPOTS} or more are advisable"
        )
    check_orientations(R)
    check_translations(R, t)


def _advice(turns: Turns, planes: Sequence[PlaneShots]) -> list[str]:
    advice = []
    rows = sum(plane.rows for plane in planes)
    if rows < ADVISABLE_SPOTS:
        advice.append(f"{rows} shots are few; {ADVISABLE_SPOTS} or more are advisable")
    if turns.rms_deg[1] < SMALL_TURN_DEG:
        advice.append(
            f"the hand turns by {turns.rms_deg[0]:.1f} deg rms about one axis and by only "
            f"{turns.rms_deg[1]:.1f} deg about a second one: turn it by 20 deg or more about two "
            "axes, both ways"
        )
    if len(planes) == 2 and min(plane.orientations for plane in planes) < 2:
        advice.append(
            "with two planes each needs two hand orientations or more, or the camera's intrinsics "
            "stay open: add an orientation, or a third plane"
        )
    short = [p.longest_mm for p in planes if p.groups and p.longest_mm < SHORT_TRANSLATION_MM]
    if short:
        advice.append(
            f"the hand moves by only {min(short):.0f} mm within its groups: moves of 90 mm and "
            "more are several times better, as far as the spot stays in the picture"
        )
    return advice


def _repeated(
    T: Array, planes: Names, cameras: Names, lasers: Names, ids: Sequence[str]
) -> list[str]:
    """Shots of one camera, laser and plane at the same hand pose."""
    first: dict[tuple[object, ...], str] = {}
    pairs = []
    rounded = np.round(T[:, :3] / _SAME_POSE).astype(np.int64)
    for k, name in enumerate(ids):
        key = (rounded[k].tobytes(), str(planes[k]), str(cameras[k]), str(lasers[k]))
        if key in first:
            pairs.append(f"{first[key]} = {name}")
        first.setdefault(key, str(name))
    if not pairs:
        return []
    return [
        f"{len(pairs)} shot{'s repeat' if len(pairs) > 1 else ' repeats'} the hand pose of another "
        f"({some(pairs)}): was the pose list read out before the hand had moved?"
    ]
