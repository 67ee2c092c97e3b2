"""Are the residuals noise? Tests of what they should not show, corrected for testing many times.

Each test takes the fit's share out first: leverage for the distribution, exact moments under
``(I - H)`` for neighbours, projected columns for trends and means.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.opinions.bench import Bench, Index
from lasercal_gtsam.opinions.chances import anderson_darling, f_above, holm, normal_above
from lasercal_gtsam.opinions.suspects import gain_of
from lasercal_gtsam.projection import beam_in_base

NEIGHBOURS = 3
"""Nearest spots of other groups that a spot is compared with."""
_FEWEST = 8
# a residual that the fit takes nearly whole says nothing of the noise
_LEAST_SHARE = 0.05
_CHUNK = 512
# more groups than any program of motions has; the time of their test grows with the cube
_MOST_GROUPS = 200


@dataclass(frozen=True)
class ResidualTest:
    """One test.

    Attributes
    ----------
    name : ``normal``, ``neighbours``, ``order``, ``distance`` or ``groups``
    asks : what is tested, in words
    value : the statistic: Anderson-Darling's A^2, correlation of neighbours, or F
    chance : probability of such a value or a worse one if the residuals are noise
    corrected : the same after Holm's correction for all the tests
    """

    name: str
    asks: str
    value: float
    chance: float
    corrected: float


def question_residuals(bench: Bench) -> tuple[ResidualTest, ...]:
    """All tests that the spots allow."""
    found: list[tuple[str, str, tuple[float, float] | None]] = [
        ("normal", "the residuals are normally distributed", _normality(bench)),
        (
            "neighbours",
            "spots near each other in the picture, of different groups, err independently (else "
            "the lens model does not fit)",
            _agreement(bench, _near_in_picture(bench)),
        ),
        (
            "order",
            "spots taken one after the other, of one group, err independently",
            _agreement(bench, _one_after_other(bench)),
        ),
        (
            "distance",
            "the error does not depend on how far the hand is from the plane",
            _by_distance(bench),
        ),
        ("groups", "no group of shots errs as a whole", _by_group(bench)),
    ]
    done = [(name, asks, result) for name, asks, result in found if result is not None]
    corrected = holm([result[1] for _, _, result in done])
    return tuple(
        ResidualTest(name, asks, *result, c)
        for (name, asks, result), c in zip(done, corrected, strict=True)
    )


def _normality(bench: Bench) -> tuple[float, float] | None:
    share = bench.free_shares
    good = share > _LEAST_SHARE
    if good.sum() < _FEWEST:
        return None
    return anderson_darling(bench.residuals[: len(share)][good] / np.sqrt(share[good]))


def _agreement(bench: Bench, pairs: Index) -> tuple[float, float] | None:
    """Mean product of the residuals of pairs (P, 2) of spots, over the noise: Moran's I.

    Its mean and variance are those of a ratio of quadratic forms in ``(I - H) e`` (Cliff and Ord,
    "Spatial processes", 1981, section 8.3); neighbours agreeing, one-sided.
    """
    if len(pairs) < _FEWEST or bench.dof < _FEWEST:
        return None
    count = len(bench)

    def beside(X: Array) -> Array:
        """Sum of the neighbours' rows: the symmetric matrix of the pairs times ``X``."""
        blocks = X[: 2 * count].reshape(count, 2, -1)
        out = np.zeros_like(blocks)
        np.add.at(out, pairs[:, 0], blocks[pairs[:, 1]])
        np.add.at(out, pairs[:, 1], blocks[pairs[:, 0]])
        return np.asarray(out.reshape(2 * count, -1))

    Q, r = bench.Q[: 2 * count], bench.residuals[: 2 * count]
    OQ = beside(Q)
    QOQ = Q.T @ OQ
    ordered = 4.0 * len(pairs)  # both directions, both coordinates
    trace = -float(np.trace(QOQ))
    squares = ordered - 2.0 * float(np.sum(OQ**2)) + float(np.sum(QOQ**2))
    dof = bench.dof
    value = float(r @ beside(r)[:, 0]) / bench.sse
    mean = trace / dof
    variance = 2.0 * (dof * squares - trace**2) / (dof**2 * (dof + 2.0))
    z = (value - mean) / np.sqrt(max(variance, 1e-300))
    return (value - mean) * dof / ordered, normal_above(float(z))


def _near_in_picture(bench: Bench) -> Index:
    """Pairs (P, 2) of spots of one camera and different groups: each with its `NEIGHBOURS`."""
    seen, pairs = bench.observations, []
    for name in seen.cameras:
        rows = np.flatnonzero(seen.camera == name)
        for some in np.array_split(rows, max(1, len(rows) // _CHUNK)):
            d = np.linalg.norm(seen.uv[some, None] - seen.uv[rows], axis=2)
            d[bench.group[some, None] == bench.group[rows]] = np.inf
            nearest = np.argsort(d, axis=1, kind="stable")[:, :NEIGHBOURS]
            ok = np.isfinite(np.take_along_axis(d, nearest, axis=1))
            pairs.append(np.column_stack([np.repeat(some, ok.sum(axis=1)), rows[nearest[ok]]]))
    every = np.sort(np.concatenate(pairs), axis=1)
    return np.asarray(np.unique(every, axis=0), dtype=np.int64)


def _one_after_other(bench: Bench) -> Index:
    k = np.arange(len(bench) - 1)
    same = bench.group[:-1] == bench.group[1:]
    same &= bench.observations.camera[:-1] == bench.observations.camera[1:]
    return np.asarray(np.column_stack([k, k + 1])[same], dtype=np.int64)


def _by_distance(bench: Bench) -> tuple[float, float] | None:
    seen = bench.observations
    length = np.empty(len(bench))
    for name in seen.lasers:
        rows = seen.laser == name
        _, q = beam_in_base(seen.T_base_hand[rows], bench.cell.lasers[name])
        length[rows] = np.linalg.norm(bench.points[rows] - q, axis=1)
    if np.ptp(length) < 1e-9:
        return None
    trend = (length - length.mean()) / np.ptp(length)
    mine = seen.camera_index[:, None] == np.arange(len(seen.cameras))
    return _f(bench, np.asarray(np.kron((trend[:, None] * mine)[:, None, :], np.eye(2)[None])))


def _by_group(bench: Bench) -> tuple[float, float] | None:
    count = int(bench.group.max()) + 1
    if count < 2 or 2 * count > len(bench) or count > _MOST_GROUPS:
        return None
    mine = bench.group[:, None] == np.arange(count)
    return _f(bench, np.asarray(np.kron(1.0 * mine[:, None, :], np.eye(2)[None])))


def _f(bench: Bench, blocks: Array) -> tuple[float, float] | None:
    gain, k = gain_of(bench, bench.columns(blocks))
    rest = bench.dof - k
    if k == 0 or rest < _FEWEST:
        return None
    value = (gain / k) / (max(bench.sse - gain, 1e-12 * bench.sse) / rest)
    return value, f_above(value, k, rest)
