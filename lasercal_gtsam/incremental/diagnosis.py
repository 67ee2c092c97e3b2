"""What has moved: the evidence of every explanation of spots that do not fit, and how far.

Each explanation is a model of the spots since the change (`explanations`, `evidence`), and Bayes'
rule compares them. One that can explain anything, such as a camera with its six degrees of freedom,
pays for it by spreading its probability over many outcomes; nobody sets a threshold. With few spots
the probabilities say that the cause is open.

- A camera, a laser or a plane has moved: a displacement of unknown size. Its prior is a mixture of
  zero-mean Gaussians of the sizes `explanations.SCALES` with equal weights, that is about uniform
  in the logarithm of the size: bumps have no typical one.
- The robot is worse than declared: every hand pose has noise of its own on top of the declared, of
  a size within `explanations.ROBOT_NOISE`. Pixels then scatter by ``S + B Sigma B'``
  (`hand_noise`).
- Outliers: nothing has changed; some spots are anywhere in the picture.

All explanations allow outliers, at the stream's rate, and the noise of pixels and declared robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.hand_noise import HandNoise, linearized
from lasercal_gtsam.incremental.belief import Belief, Part
from lasercal_gtsam.incremental.evidence import Scene
from lasercal_gtsam.incremental.explanations import (
    NEGLIGIBLE,
    Explanation,
    Move,
    bad_spots,
    worse_robot,
)
from lasercal_gtsam.incremental.update import Cause, CauseKind
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

PRIOR_ODDS: dict[CauseKind, float] = {
    "camera": 1.0,
    "laser": 1.0,
    "plane": 1.0,
    "robot": 1.0,
    "outliers": 1.0,
}
"""Odds of each camera, laser and plane, of the robot and of outliers before the spots are looked
at. Equal: cells differ too much for one list of what is touched most, and an alarm was raised, so
that "nothing moved" has no head start."""
SURE = 0.95
"""Probability from which on a cause is called known."""
# outlier rates that a stream may be said to have
_RATES = (1e-4, 0.3)
_NAMES: dict[CauseKind, str] = {
    "camera": "camera {!r} moved",
    "laser": "laser {!r} moved",
    "plane": "plane {!r} moved",
    "robot": "the robot is less precise than declared",
    "outliers": "nothing moved, some spots are bad",
}
_SHORT: dict[CauseKind, str] = {
    "camera": "camera {!r}",
    "laser": "laser {!r}",
    "plane": "plane {!r}",
    "robot": "robot",
    "outliers": "bad spots",
}


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Explanations of spots that do not fit, the most probable first.

    Attributes
    ----------
    causes : with their probabilities, which add up to one
    words : one sentence
    cell : the cell after the change if the most probable cause is right: a start for `fuse`
    good : (m,) probability, if so, that each spot is no outlier
    """

    causes: tuple[Cause, ...]
    words: str
    cell: Cell
    good: Array

    @property
    def settled(self) -> bool:
        """Whether the most probable cause is probable enough to act on.

        `SURE` for what has moved, and for the robot. For outliers one half: displacements too small
        to be seen explain good spots about as well as none, and keep a share for any number of
        spots.
        """
        best = self.causes[0]
        return best.probability >= (0.5 if best.kind == "outliers" else SURE)


def diagnose(
    belief: Belief,
    observations: Observations,
    cov_uv: Array,
    *,
    outlier_rate: float,
    hand_noise: HandNoise | None = None,
) -> Diagnosis:
    """Compare all explanations of the spots since a change.

    Parameters
    ----------
    belief : what was known before; has all the parts that the spots involve
    observations : m spots since the suspected onset
    cov_uv : (m, 2, 2) covariances of their pixels, px^2, the residual scale applied
    outlier_rate : share of outliers in the stream so far
    hand_noise : declared noise of the hand poses

    Raises
    ------
    DataError
        There are no spots, or a part of theirs is not in the belief.
    DegenerateError
        The belief does not determine what the spots involve.
    """
    if not len(observations):
        raise DataError("diagnose: no spots to explain")
    for kind in ("camera", "laser", "plane"):
        for name in getattr(observations, f"{kind}s"):
            if name not in getattr(belief.cell, f"{kind}s"):
                raise DataError(f"diagnose: {kind} {name!r} has spots but is not in the belief")
    scene = Scene.of(belief, observations, float(np.clip(outlier_rate, *_RATES)))
    B, _ = linearized(observations, belief.cell, np.zeros((len(observations), 6)))
    declared = hand_noise or HandNoise(0.0, 0.0)
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, declared.variances, B)
    found = [bad_spots(scene, S), worse_robot(scene, S, B, declared)]
    moves = [Move.of(scene, observations, S, *part) for part in _parts(observations)]
    logs = [e.log_evidence for e in found] + [m.largest.log_evidence for m in moves]
    found += [move.averaged(scene, S, max(logs) - NEGLIGIBLE) for move in moves]
    score = np.array([e.log_evidence + np.log(PRIOR_ODDS[e.kind]) for e in found])
    probability = np.exp(score - np.logaddexp.reduce(score))
    order = np.argsort(-probability, kind="stable")
    causes = tuple(
        _cause(found[i], float(probability[i]), found[i].log_evidence - found[0].log_evidence)
        for i in order
    )
    best = found[order[0]]
    return Diagnosis(causes, _words(causes, len(observations)), best.cell, best.good)


def _parts(observations: Observations) -> Iterator[tuple[Part, str]]:
    yield from (("camera", name) for name in observations.cameras)
    yield from (("laser", name) for name in observations.lasers)
    yield from (("plane", name) for name in observations.planes)


def _cause(e: Explanation, probability: float, log_likelihood: float) -> Cause:
    shift, sigma_shift = (MM_PER_M * x for x in e.shift)
    turn, sigma_turn = (DEG_PER_RAD * x for x in e.turn)
    words = _NAMES[e.kind].format(e.name)
    if e.kind == "robot":
        words += f": about {_pair(shift, sigma_shift)} mm and {_pair(turn, sigma_turn)} deg"
    elif e.kind != "outliers":
        words += f" by {_pair(shift, sigma_shift)} mm and {_pair(turn, sigma_turn)} deg"
    return Cause(
        e.kind, e.name, probability, log_likelihood, shift, sigma_shift, turn, sigma_turn, words
    )


def _words(causes: Sequence[Cause], spots: int) -> str:
    first, second = causes[:2]
    if first.probability >= SURE:
        following = f"next: {_short(second)}"
        return f"{first.words} (probability {first.probability:.2g}; {following})"
    open_ones = [c for c in causes if c.probability >= 1.0 - SURE]
    listed = "; ".join(f"{c.words} ({c.probability:.2g})" for c in open_ones)
    counted = f"{spots} spot" + ("s" if spots > 1 else "")
    return f"the cause is open after {counted}: {listed}; spots over all planes will tell"


def _short(cause: Cause) -> str:
    return f"{_SHORT[cause.kind].format(cause.name)}, {cause.probability:.1g}"


def _pair(value: float, sigma: float) -> str:
    """Value +- sigma, both to the sigma's second digit."""
    decimals = int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"
