"""Stage 0: groups of non-rotating motions, found from the hand poses (the paper's pairs (p, m)).

The paper moves the hand by pure translations from a few start poses; every such set of shots on one
plane is a group. Nobody labels them: they are found from the poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.closed_form.spots import Index, Spots
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import nearest_rotation
from lasercal_gtsam.units import RAD_PER_DEG

GROUP_TOLERANCE_RAD = 0.05 * RAD_PER_DEG
MOST_SPOTS = 3000
_FEWEST_OF_A_PLANE = 200
SMALLEST_GROUP = 4
"""Four shots fix the homography of a group."""


@dataclass(frozen=True, eq=False)
class Groups:
    """G groups, padded to the K shots of the largest.

    Attributes
    ----------
    R : (G, 3, 3) hand rotation of each group
    plane : (G,) plane index
    xy : (G, K, 2) scaled pixels
    t : (G, K, 3) hand positions, metres
    present : (G, K) 1 where there is a shot, 0 where the row is padding
    rows : (G, K) number of each shot among the spots; -1 where the row is padding
    """

    R: Array
    plane: Index
    xy: Array
    t: Array
    present: Array
    rows: Index

    def __len__(self) -> int:
        return len(self.R)

    def subset(self, which: Index) -> Groups:
        """Select groups by index."""
        width = int(self.present[which].sum(axis=1).max(initial=0))
        return Groups(
            self.R[which],
            self.plane[which],
            self.xy[which, :width],
            self.t[which, :width],
            self.present[which, :width],
            self.rows[which, :width],
        )

    def masked(self, kept: npt.NDArray[np.bool_]) -> Groups:
        """The shots that are kept, (G, K); groups that are left with none stay, empty."""
        order = np.argsort(~kept, axis=1, kind="stable")
        row = np.arange(len(self))[:, None]
        xy, t, rows = self.xy[row, order], self.t[row, order], self.rows[row, order]
        there = np.take_along_axis(kept, order, axis=1)
        every = np.arange(len(self))
        packed = Groups(
            self.R, self.plane, xy, t, there.astype(np.float64), np.where(there, rows, -1)
        )
        return packed.subset(every)

    @property
    def shots(self) -> Index:
        """(G,) number of shots of each group."""
        return np.asarray(self.present.sum(axis=1), dtype=np.int64)

    def translation_ranks(self, tolerance: float = 1e-3) -> Index:
        """(G,) rank of each group's translations (singular values relative to the largest)."""
        total = self.present.sum(axis=1)[:, None]
        centre = (self.t * self.present[..., None]).sum(axis=1) / total
        moves = (self.t - centre[:, None]) * self.present[..., None]
        s = np.linalg.svd(moves, compute_uv=False)
        return np.asarray((s > tolerance * np.maximum(s[:, :1], 1e-300)).sum(axis=1), np.int64)


def group_labels(R: Array, plane: Index, tolerance_rad: float = GROUP_TOLERANCE_RAD) -> Index:
    """Label every shot with its group: same plane, same hand rotation within the tolerance.

    A group grows about one member and does not chain, so a slowly turning hand does not become one
    group. The result does not depend on the order of the shots.

    Parameters
    ----------
    R : (N, 3, 3) hand rotations
    plane : (N,) plane indices
    tolerance_rad : largest angle to the group's first member; for poses read back from the robot
        about four times their rotation noise

    Returns
    -------
    (N,) labels 0, 1, ...
    """
    labels = np.full(len(R), -1, dtype=np.int64)
    # |A - B| (Frobenius) = 2 sqrt(2) sin(angle / 2)
    chord = 2.0 * np.sqrt(2.0) * np.sin(0.5 * tolerance_rad)
    key = R.reshape(-1, 9) @ np.array([0.61, -0.37, 0.19, 0.29, 0.53, -0.23, 0.11, 0.07, -0.13])
    reach = chord + 1e-12  # the weights have norm below 1, so keys differ by less than chords
    count = 0
    for p in np.unique(plane):
        rows = np.flatnonzero(plane == p)
        rows = rows[np.argsort(key[rows], kind="stable")]
        keys = key[rows]
        ends = np.searchsorted(keys, keys + reach, side="right")
        for first, seed in enumerate(rows):
            if labels[seed] >= 0:
                continue
            near = rows[first : ends[first]]
            near = near[labels[near] < 0]
            distance = np.linalg.norm((R[near] - R[seed]).reshape(-1, 9), axis=1)
            labels[near[distance <= chord]] = count
            count += 1
    return labels


def find_groups(spots: Spots, tolerance_rad: float = GROUP_TOLERANCE_RAD) -> Groups:
    """Groups of at least `SMALLEST_GROUP` shots, ordered by plane.

    A group's rotation is the mean of its members'.
    """
    labels = group_labels(spots.R, spots.plane, tolerance_rad)
    sizes = np.bincount(labels, minlength=1)
    members = [np.flatnonzero(labels == g) for g in np.flatnonzero(sizes >= SMALLEST_GROUP)]
    members.sort(key=lambda rows: (int(spots.plane[rows[0]]), int(rows[0])))
    width = max((len(rows) for rows in members), default=0)
    xy, t = np.zeros((len(members), width, 2)), np.zeros((len(members), width, 3))
    present = np.zeros((len(members), width))
    numbers = np.full((len(members), width), -1, dtype=np.int64)
    R = np.zeros((len(members), 3, 3))
    for g, rows in enumerate(members):
        xy[g, : len(rows)], t[g, : len(rows)] = spots.xy[rows], spots.t[rows]
        present[g, : len(rows)], numbers[g, : len(rows)] = 1.0, rows
        R[g] = spots.R[rows].mean(axis=0)
    plane = np.array([spots.plane[rows[0]] for rows in members], dtype=np.int64)
    return Groups(nearest_rotation(R) if len(R) else R, plane, xy, t, present, numbers)


def thinned(
    spots: Spots, most: int = MOST_SPOTS, tolerance_rad: float = GROUP_TOLERANCE_RAD
) -> Spots:
    """At most about ``most`` spots, evenly over planes and groups, whole groups where possible.

    A start gains nothing from more, and the cost of the stages grows with their number.
    """
    if len(spots) <= most:
        return spots
    labels = group_labels(spots.R, spots.plane, tolerance_rad)
    kept: list[Index] = []
    for p in range(spots.plane_count):
        rows = spots.on_plane(p)
        budget = max(most * len(rows) // len(spots), _FEWEST_OF_A_PLANE)
        members = np.split(
            rows[np.argsort(labels[rows], kind="stable")],
            np.cumsum(np.unique(labels[rows], return_counts=True)[1])[:-1],
        )
        step = -(-len(rows) // budget)
        if len(members) >= 10 * step:
            kept += members[::step]
        else:
            kept += [group[::step] for group in members]
    return spots.subset(np.sort(np.concatenate(kept)))
