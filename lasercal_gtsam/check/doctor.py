"""The convention doctor: which reading of a capture's numbers agrees with its spots.

Every reading is solved without a start, as a calibration would be, and judged by the robust
residual that is left. Most wrong readings are found out much earlier, at first sight (`screening`),
and not solved.

Nothing is switched: the doctor only says what it found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lasercal_gtsam.check.diagnosis import AS_GOOD, Diagnosis, judge
from lasercal_gtsam.check.readings import AS_DECLARED, MIRRORED, TURNED, PoseReading
from lasercal_gtsam.check.trials import HOPELESS, Bench, Progress, Solved, Steps, Trial
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Index, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.robust import rejection_length

_MOST_SPOTS = 300
# where even the best leaves too much at first sight, this many are solved: nobody can say why
_KEPT = 12
_MOST_REFINED = 5
_MOST_RETRIED = 1
# share of the spots that fit a reading if there are no outliers
_NEARLY_ALL = 0.95


def diagnose(
    observations: Observations,
    poses: Sequence[PoseReading],
    options: CalibrationOptions,
    progress: Progress | None = None,
) -> Diagnosis:
    """Try the readings of a capture on its spots.

    Parameters
    ----------
    observations : N spots; of more than 300 of a camera and a laser an even choice is tried
    poses : readings of the hand poses of the same N spots, the declared one first
    options : as for the calibration; what is known of cameras and robot is used
    progress : called with (readings done, readings to do)

    Raises
    ------
    DataError
        The options do not fit the observations.
    DegenerateError
        No reading can be solved, whatever the pixels are: the poses do not suffice.
    """
    rows = _evenly(observations)
    poses = [replace(pose, T_base_hand=pose.T_base_hand[rows]) for pose in poses]
    bench = Bench.of(observations[rows], options)
    steps = Steps(progress, len(poses))
    trials = [Trial(pose, AS_DECLARED) for pose in poses]
    misfits = bench.misfits_px(trials, steps)
    likely = int(np.argmin(misfits))
    if misfits[likely] > bench.credible_px:  # perhaps only because the pixels are mirrored
        mirrored = bench.misfits_px([Trial(pose, MIRRORED[0]) for pose in poses], steps)
        likely = int(np.argmin(mirrored))
    more = [Trial(poses[0], TURNED)]
    more += [Trial(poses[k], pixels) for k in sorted({0, likely}) for pixels in MIRRORED]
    misfits = np.concatenate([misfits, bench.misfits_px(more, steps)])
    trials += more
    worth = _worth_solving(misfits, bench.credible_px)
    solved = {k: bench.solve(trials[k]) for k in steps.through(worth)}
    if all(s.trouble for s in solved.values()):
        raise DegenerateError(solved[0].trouble)
    ranked = sorted(solved, key=lambda k: solved[k].residual_px)
    refined = {*ranked[:_MOST_REFINED], *(k for k in solved if trials[k].pose is poses[0])}
    for k in steps.through(sorted(refined)):
        solved[k] = bench.refine(solved[k])
    for k in steps.through(_next_best(solved, len(poses))):
        if _spoiled(k, solved, bench.credible_px):
            solved[k] = bench.retry(solved[k])
    limit_px = _limit_px(solved)
    judged = [
        solved[k].judged(limit_px) if k in solved else trial.screened(float(misfits[k]))
        for k, trial in enumerate(trials)
    ]
    return judge(judged, len(rows), bench.diagonal_px)


def _limit_px(solved: Mapping[int, Solved]) -> float:
    """Residual up to which a spot fits, within the noise of the best reading."""
    best = min(solved.values(), key=lambda s: s.residual_px)
    return rejection_length(len(best.lengths)) * best.residual_px


def _next_best(solved: Mapping[int, Solved], poses: int) -> list[int]:
    """The declared trial (0), and the best other reading of the poses."""
    ranked = sorted((k for k in solved if 0 < k < poses), key=lambda k: solved[k].residual_px)
    return [0, *ranked[:_MOST_RETRIED]]


def _spoiled(k: int, solved: Mapping[int, Solved], credible_px: float) -> bool:
    """Whether outliers may have spoiled a trial.

    Not where some reading explains nearly all spots: then there are no outliers. Otherwise the
    declared one (0), unless it fits as well as any; and every one where nothing fits.
    """
    best = min(solved.values(), key=lambda s: s.residual_px)
    if not best.residual_px <= credible_px:
        return True
    fitting = float((best.lengths <= _limit_px(solved)).mean())
    as_good = solved[k].residual_px <= AS_GOOD * best.residual_px
    return k == 0 and fitting < _NEARLY_ALL and not as_good


def _worth_solving(misfits_px: Array, credible_px: float) -> list[int]:
    """The declared trial (0), and those not hopeless at first sight; where all are, the best."""
    best = float(np.min(misfits_px[misfits_px > 0], initial=np.inf))  # 0: nothing can be said
    if not np.isfinite(best):
        return list(range(len(misfits_px)))
    if best <= credible_px:
        promising = np.flatnonzero(misfits_px <= HOPELESS * best)
    else:
        promising = np.argsort(misfits_px, kind="stable")[:_KEPT]
    return sorted({0, *(int(k) for k in promising)})


def _evenly(observations: Observations) -> Index:
    """Rows of an even choice of spots, whole groups where possible: a reading needs no more."""
    from lasercal_gtsam.closed_form.groups import thinned
    from lasercal_gtsam.closed_form.spots import Spots, pairs_of

    chosen = [
        thinned(Spots.of_pair(observations, camera, laser), _MOST_SPOTS).rows
        for camera, laser in pairs_of(observations)
    ]
    return np.sort(np.concatenate(chosen))
