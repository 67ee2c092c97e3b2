"""Which shots agree with each other, where nearly half of them may be outliers.

The whole cell has some thirty unknowns, far too many to try random samples of spots. But the
problem falls into small parts. Given the direction ``u`` of the beam (two unknowns, the same for
all), the pixels of each group of non-rotating motions are a homography of ``s = (R_g E_u)' t``,
which four shots fix; and given the vanishing line of its plane, three. So:

1. directions over the hemisphere are ranked by how many shots agree with the best homographies;
2. for the best of them, each group's best homographies propose vanishing lines, and the line with
   which most shots of all groups of the plane agree is taken;
3. the direction is polished on the shots that agree, and 2. repeated.

A group counts only where more of its shots agree than chance would bring together (the a-contrario
criterion of Moisan & Stival 2004). The lens's distortion is not in the maps; the limits leave it
room.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb, log

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.closed_form.direction import (
    SHOTS_FOR_KERNEL,
    SHOTS_FOR_POLISH,
    across_beam,
    best_distinct_index,
    hemisphere,
    polish_directions,
)
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.linear import dlt
from lasercal_gtsam.closed_form.samples import Samples
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL, Index
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.units import RAD_PER_DEG

Mask = npt.NDArray[np.bool_]

COARSE = 0.012 * IMAGE_DIAGONAL
FINE = 0.006 * IMAGE_DIAGONAL
"""Distances up to which a shot agrees, while directions are searched and in the end."""
# area of a picture of 4:3, with which the chance of an agreement is reckoned
_IMAGE_AREA = 0.48 * IMAGE_DIAGONAL**2
_CHANCE = 1e-2
_DIRECTIONS, _KEPT, _DISTINCT_RAD = 250, 8, 6.0 * RAD_PER_DEG
_SEARCHED_GROUPS, _SEARCHED_FOURS, _FOURS, _THREES = 12, 120, 210, 120
_LINES = 8
_POLISHED = 2
# two scores nearer than this are the same consensus, found twice
_SAME = 0.95


@dataclass(frozen=True, eq=False)
class Agreement:
    """A consensus of shots.

    Attributes
    ----------
    u : (3,) beam direction, hand frame
    members : numbers of the spots that agree, for each group; the smallest first
    score : how many agree beyond chance, those near the limit counting less
    """

    u: Array
    members: tuple[Index, ...]
    score: float

    @property
    def rows(self) -> Index:
        """Numbers of all spots that agree, in order."""
        return np.sort(np.concatenate(self.members))

    def parts(self) -> Iterator[Index]:
        """All of them, then without one group each.

        The smallest group first: it is the likeliest to have a wrong shot among its own.
        """
        yield self.rows
        for left_out in range(len(self.members)):
            others = self.members[:left_out] + self.members[left_out + 1 :]
            if others:
                yield np.sort(np.concatenate(others))


def agreements(groups: Groups, seed: int = 0) -> list[Agreement]:
    """Sets of shots that agree with each other, the largest first.

    Parameters
    ----------
    groups : of one camera and laser
    seed : of the random samples

    Returns
    -------
    list
        Empty where no group has more shots that agree than chance brings together.
    """
    groups = groups.subset(np.flatnonzero(groups.shots >= SHOTS_FOR_POLISH))
    if not len(groups):
        return []
    consensus = _Consensus.of(groups, np.random.default_rng(seed))
    found = []
    for u in consensus.directions():
        kept, score = consensus.agreeing(u, COARSE)
        for _ in range(_POLISHED):
            firm = groups.masked(kept)
            firm = firm.subset(np.flatnonzero(firm.shots >= SHOTS_FOR_KERNEL))
            if len(firm):
                u = polish_directions(firm, u[None])[0][0]
            kept, score = consensus.agreeing(u, FINE)
        if not kept.any():
            continue
        members = [rows[own] for rows, own in zip(groups.rows, kept, strict=True) if own.any()]
        found.append(Agreement(u, tuple(sorted(members, key=len)), score))
        best = max(agreement.score for agreement in found)
        if sum(agreement.score > _SAME * best for agreement in found) > 1:
            break
    return sorted(found, key=lambda agreement: -agreement.score)


@dataclass(frozen=True, eq=False)
class _Consensus:
    groups: Groups
    fours: Samples
    threes: Samples

    @classmethod
    def of(cls, groups: Groups, rng: np.random.Generator) -> _Consensus:
        fours = Samples.draw(groups, 4, _FOURS, rng)
        return cls(groups, fours, Samples.draw(groups, 3, _THREES, rng))

    def directions(self) -> Array:
        """Directions with which most shots agree, over the hemisphere, best first: (D, 3)."""
        from lasercal_factors.sample_kernels import homography_gains

        some = _of_all_planes(self.groups, _SEARCHED_GROUPS)
        groups = self.groups.subset(some)
        shots = self.fours.shots[some]
        counts = np.minimum(self.fours.counts[some], _SEARCHED_FOURS)
        u = hemisphere(_DIRECTIONS)
        scores = np.empty(len(u))
        for i, s in enumerate(across_beam(groups, u)):
            gains = homography_gains(
                _centred(s, groups), groups.xy, groups.shots, shots, counts, COARSE**2
            )
            scores[i] = np.maximum(gains.max(axis=1, initial=0.0) - 4.0, 0.0).sum()
        return u[best_distinct_index(u, -scores, _KEPT, _DISTINCT_RAD)]

    def agreeing(self, u: Array, limit: float) -> tuple[Mask, float]:
        """Shots (G, K) that agree with a direction, and how many in all beyond chance."""
        from lasercal_factors.sample_kernels import best_affine, homography_gains

        groups = self.groups
        s = _centred(across_beam(groups, u[None])[0], groups)
        gains = homography_gains(
            s, groups.xy, groups.shots, self.fours.shots, self.fours.counts, limit**2
        )
        agree = np.zeros(groups.present.shape, dtype=np.bool_)
        score = 0.0
        for p in np.unique(groups.plane):
            mine = np.flatnonzero(groups.plane == p)
            best = 0.0
            for line in self._lines(s, gains, mine, limit):
                value, maps = best_affine(
                    line,
                    basis_of(line),
                    s[mine],
                    groups.xy[mine],
                    groups.shots[mine],
                    self.threes.shots[mine],
                    self.threes.counts[mine],
                    limit**2,
                )
                total = float(np.maximum(value - 4.0, 0.0).sum())
                if total > best:
                    best = total
                    agree[mine] = _near(maps, s[mine], groups, mine, limit)
            score += best
        return agree, score

    def _lines(self, s: Array, gains: Array, mine: Index, limit: float) -> list[Array]:
        """Vanishing lines that the best homographies of a plane's groups propose."""
        from lasercal_factors.sample_kernels import homography_through

        groups = self.groups
        which = [(gains[g, m], g, m) for g in mine for m in np.argsort(-gains[g])[:2]]
        which = sorted(((x, g, m) for x, g, m in which if x > 4.0), reverse=True)[:_LINES]
        lines = []
        for _, g, m in which:
            H = np.empty((3, 3))
            homography_through(s[g], groups.xy[g], self.fours.shots[g, m], H)
            near = _near(H[None], s[g][None], groups, np.array([g]), limit)[0]
            if near.sum() > 4:
                H = dlt(s[g][near], groups.xy[g][near])
            line = np.cross(H[:, 0], H[:, 1])
            lines.append(line / np.linalg.norm(line))
        return lines


def _near(maps: Array, s: Array, groups: Groups, mine: Index, limit: float) -> Mask:
    """Shots that agree with the map of their group, none of groups where it may be chance."""
    image = s @ np.swapaxes(maps[:, :, :2], 1, 2) + maps[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(image[..., :2] / image[..., 2:] - groups.xy[mine], axis=-1)
    near = (error < limit) & (groups.present[mine] > 0)
    enough = np.array([fewest_agreeing(int(n), limit) for n in groups.shots[mine]])
    return np.asarray(near & (near.sum(axis=1) >= enough)[:, None])


def fewest_agreeing(count: int, limit: float) -> int:
    """Shots out of ``count`` that must agree with a map through three of them not to be chance.

    Expected number of maps with that many by chance below 1 %: Moisan & Stival 2004.
    """
    chance = np.pi * limit**2 / _IMAGE_AREA
    for k in range(4, count + 1):
        maps = comb(count, 3) * comb(count - 3, k - 3)
        if log(_LINES * maps) + (k - 3) * log(chance) < log(_CHANCE):
            return k
    return count + 1


def _centred(s: Array, groups: Groups) -> Array:
    there = groups.present[..., None]
    centre = (s * there).sum(axis=1, keepdims=True) / there.sum(axis=1, keepdims=True)
    return np.asarray((s - centre) * there)


def _of_all_planes(groups: Groups, most: int) -> Index:
    """The groups with most shots, of all planes in turn."""
    turn = np.zeros(len(groups), dtype=np.int64)
    for p in np.unique(groups.plane):
        mine = np.flatnonzero(groups.plane == p)
        turn[mine[np.argsort(-groups.shots[mine], kind="stable")]] = np.arange(len(mine))
    return np.sort(np.argsort(turn, kind="stable")[:most])
