"""Notice, spot by spot, that something is no longer as it was, and since when.

Every spot is compared with what was expected before it was used. Two kinds of change are watched
for in each part: a shift of a few magnitudes, whose pixels agree with each other through the
Jacobians, and a run of gross outliers (bumped beyond prediction); besides, residuals wider than
declared (the robot). All are likelihood ratios against "unchanged, with outliers at their running
rate", summed over the possible onsets: the statistic of Shiryaev (1963) and Roberts (1966). An
alarm is raised where it reaches the threshold, which is then a lower bound for the mean number of
good spots between false alarms (Pollak 1985); see `lasercal_factors.change_kernels`.

The bound is exact where outliers come one by one, at the rate that is estimated, as likely anywhere
in the picture or crowded about the spot; ghosts that all lie at one offset look like a moved part.

A sluggish calibrator absorbs part of a lasting change; the ratios neglect that (Willsky and Jones
1976 do not), which costs power for changes that need about as many spots as there were before, and
never a false alarm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from lasercal_factors import change_kernels as kernels
from lasercal_factors.change_arrays import LAG, Bank, Looks, Watch
from lasercal_factors.change_rates import overall_rate

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.incremental.detector_state import (
    KINDS,
    covering,
    empty_watch,
    forget_evidence,
    from_arrays,
    to_arrays,
)
from lasercal_gtsam.incremental.looks import Look, Onset, Verdict, plain, single

__all__ = ["DEFAULT_THRESHOLD", "Detector", "Look", "Looks", "Onset", "Verdict"]

DEFAULT_THRESHOLD = 100_000.0


@dataclass
class Detector:
    """Sequential test for a change; changed in place by `look`, deterministic.

    Attributes
    ----------
    watch : the whole state as plain arrays (`lasercal_factors.change_kernels.Watch`)
    threshold : lower bound of the mean number of good spots to a false alarm
    """

    watch: Watch
    threshold: float = DEFAULT_THRESHOLD

    @classmethod
    def start(
        cls,
        cameras: int = 1,
        lasers: int = 1,
        planes: int = 1,
        *,
        outliers: float = 0.0,
        good: float = 0.0,
        threshold: float = DEFAULT_THRESHOLD,
    ) -> Detector:
        """Begin with that many parts.

        Parameters
        ----------
        cameras, lasers, planes : numbers of parts; more may come later (`cover`)
        outliers, good : spots seen before, rejected and used: where the overall rate of outliers
            starts; `remember` tells those of the parts too
        threshold : alarm threshold, > 1

        Raises
        ------
        DataError
            A number that makes no sense.
        """
        if not threshold > 1 or not math.isfinite(threshold):
            raise DataError(f"detector threshold: expected a number of spots > 1, got {threshold}")
        if not (outliers >= 0 and good >= 0 and math.isfinite(outliers + good)):
            raise DataError(f"detector: expected counts >= 0, got {outliers} outliers, {good} good")
        watch = empty_watch(cameras, lasers, planes, outliers, outliers + good)
        return cls(watch, float(threshold))

    @property
    def number(self) -> int:
        """Spots looked at since the start."""
        return int(self.watch.number[0])

    @property
    def outlier_rate(self) -> float:
        """Running rate of outliers over all parts."""
        return float(overall_rate(self.watch.outliers))

    def cover(self, cameras: int, lasers: int, planes: int) -> None:
        """Make room for at least so many parts; new ones start with nothing seen."""
        self.watch = covering(self.watch, cameras, lasers, planes)

    def remember(self, who: npt.NDArray[np.int64], outlier: npt.NDArray[np.bool_]) -> None:
        """Count spots of an earlier calibration, so that each part's rate of outliers is known.

        Parameters
        ----------
        who : (N, 3) indices of camera, laser and plane
        outlier : (N,) was rejected

        Raises
        ------
        DataError
            Shapes that do not fit or an index out of range.
        """
        who, outlier = np.asarray(who), np.asarray(outlier, dtype=np.bool_)
        if who.shape != (len(outlier), 3):
            raise DataError(f"detector: who: expected shape {(len(outlier), 3)}, got {who.shape}")
        problems = self._out_of_range(who)
        if problems:
            raise DataError(*problems)
        self.watch.outliers[:] += [float(np.sum(outlier)), float(len(outlier))]
        for kind, index in zip(KINDS, who.T, strict=True):
            counts = getattr(self.watch, kind).outliers
            np.add.at(counts, index, np.column_stack([outlier, np.ones(len(outlier))]))

    def look(self, spot: Look) -> Verdict:
        """Take in one spot.

        Raises
        ------
        DataError
            Shapes, indices or numbers that cannot be.
        """
        return self.look_many(single(spot))[0]

    def look_many(self, looks: Looks) -> list[Verdict]:
        """Take in spots in order, up to the first alarm: may return fewer verdicts than spots."""
        looks = plain(looks)
        out = np.empty((len(looks.e), 4))
        log_threshold = math.log(self.threshold)
        count = kernels.look(self.watch, looks, log_threshold, out)
        if count < 0:
            raise DataError(*self._problems(looks))
        return [self._verdict(row, log_threshold) for row in out[:count].tolist()]

    def reset(self, since: int | None = None) -> None:
        """Forget all evidence; the rates of outliers stay.

        Parameters
        ----------
        since : from this spot on, nothing counts as an outlier any more either (a part had moved)
        """
        if since is not None:
            self._uncount(since)
        forget_evidence(self.watch)

    def onsets(self) -> list[Onset]:
        """Every onset that is considered, with its weight, the heaviest first."""
        found = []
        for kind in KINDS:
            bank: Bank = getattr(self.watch, kind)
            for p, m, k in zip(*np.nonzero(np.isfinite(bank.log_weight)), strict=True):
                first, weight = int(bank.first[p, m, k]), float(bank.log_weight[p, m, k])
                found.append(Onset(kind, int(p), first, weight))
            for p, (weight, _, first) in enumerate(bank.run.tolist()):
                found.append(Onset(f"run of {kind}", p, int(first), weight))
        for weight, _, first in self.watch.spread.tolist():
            found.append(Onset("spread", 0, int(first), weight))
        return sorted((o for o in found if o.log_weight > -np.inf), key=lambda o: -o.log_weight)

    def since(self) -> int | None:
        """Most probable first spot of a change, over all causes; None before the first spot."""
        weights: dict[int, float] = {}
        onsets = self.onsets()
        for o in onsets:
            weights[o.first] = weights.get(o.first, 0.0) + math.exp(
                o.log_weight - onsets[0].log_weight
            )
        return max(weights, key=lambda first: (weights[first], first)) if weights else None

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return copies of the whole state by name, for a checkpoint."""
        return {"threshold": np.array(self.threshold), **to_arrays(self.watch)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Detector:
        """Undo `arrays`: goes on with exactly the same numbers.

        Raises
        ------
        DataError
            An array is missing or is not what it must be.
        """
        if "threshold" not in arrays:
            raise DataError("detector: the saved state has no array 'threshold'")
        return cls(from_arrays(arrays), float(arrays["threshold"]))

    def _verdict(self, row: list[float], log_threshold: float) -> Verdict:
        log_statistic, length, limit, probability = row
        outlier, alarm = probability > 0.5, log_statistic >= log_threshold
        reason = ""
        if outlier and math.isinf(length):
            reason = "no spot should be there at all"
        elif outlier:
            reason = f"{length:.3g} sigma from where it was expected; the limit is {limit:.3g}"
        since = self.since() if alarm else None
        return Verdict(outlier, reason, alarm, since, log_statistic / log_threshold, length, limit)

    def _problems(self, looks: Looks) -> list[str]:
        """What is wrong with spots that were turned down."""
        n = len(looks.e)
        shapes = ((n, 2), (n, 3), (n, 2, 6), (n, 2, 4), (n, 2, 3), (n,), (n,))
        found = [
            f"detector: {name}: expected shape {shape}, got {array.shape}"
            for name, array, shape in zip(Looks._fields, looks, shapes, strict=True)
            if array.shape != shape
        ]
        if found:
            return found
        found = self._out_of_range(looks.who)
        if not (np.all(looks.area > 0) and np.all(looks.dof > 0)):
            found.append("detector: area and degrees of freedom must be positive")
        return found or ["detector: derivatives must be finite, and a plane must move its spots"]

    def _out_of_range(self, who: npt.NDArray[np.int64]) -> list[str]:
        found = []
        for kind, index in zip(KINDS, who.T, strict=True):
            count = len(getattr(self.watch, kind).seen)
            bad = index[(index < 0) | (index >= count)]
            if len(bad):
                found.append(f"detector: {kind}: there are {count}, got index {bad[0]}")
        return found

    def _uncount(self, since: int) -> None:
        watch = self.watch
        for i in range(max(since, self.number - len(watch.recent), 0), self.number):
            probability, *parts = watch.recent[i % len(watch.recent)]
            watch.outliers[0] = max(watch.outliers[0] - probability, 0.0)
            counted = KINDS if i < self.number - LAG else ()
            for kind, p in zip(counted, parts, strict=False):
                counts = getattr(watch, kind).outliers[int(p)]
                counts[0] = max(counts[0] - probability, 0.0)
            watch.recent[i % len(watch.recent), 0] = 0.0
