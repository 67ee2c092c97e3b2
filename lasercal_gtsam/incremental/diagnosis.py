"""What has moved: the evidence of every explanation of spots that do not fit, and how far.

Each explanation is a model of the spots since the change (`evidence`), and Bayes' rule compares
them. One that can explain anything, such as a camera with its six degrees of freedom, pays for it
by spreading its probability over many outcomes; nobody sets a threshold. With few spots the
probabilities say that the cause is open.

- A camera, a laser or a plane has moved: a displacement of unknown size. Its prior is a mixture of
  zero-mean Gaussians from `SCALES` with equal weights, that is about uniform in the logarithm of
  the size: bumps have no typical size.
- The robot is worse than declared: every hand pose has noise of its own on top of the declared, of
  a size out of `ROBOT_NOISE`. Pixels then scatter by ``S + B Sigma B'`` (`hand_noise`).
- Outliers: nothing has changed; some spots are anywhere in the picture.

All explanations allow outliers, at the stream's rate, and the noise of pixels and declared robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError, LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.hand_noise import HandNoise, linearized
from lasercal_gtsam.incremental.belief import Belief, Part, coordinates
from lasercal_gtsam.incremental.change import (
    TURNS,
    change_basis,
    change_between,
    middle_of_spots,
)
from lasercal_gtsam.incremental.evidence import Mode, Scene
from lasercal_gtsam.incremental.relocate import locate_camera, locate_laser, locate_plane
from lasercal_gtsam.incremental.update import Cause, CauseKind
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.units import DEG_PER_RAD, M_PER_MM, MM_PER_M, RAD_PER_DEG

SCALES = np.geomspace(1.0, 200.0, 8)
"""Sizes of displacements, in units of `TURN_UNIT` and `SHIFT_UNIT`: 0.1 deg, 0.5 mm to 20, 100."""
TURN_UNIT, SHIFT_UNIT = 0.1 * RAD_PER_DEG, 0.5 * M_PER_MM
ROBOT_NOISE = np.geomspace(0.1, 12.8, 8)
"""Sizes of additional hand noise, in units of `ROBOT_UNIT`."""
ROBOT_UNIT = HandNoise(1.0 * M_PER_MM, 0.1 * RAD_PER_DEG)
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
# a mode explains the spots if at most this share of them counts as outliers
_EXPLAINED = 0.8
# differences of log evidence, and probabilities of sizes, that no longer matter
_NEGLIGIBLE, _NO_WEIGHT = 20.0, 1e-4
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


@dataclass(frozen=True, eq=False)
class _Explanation:
    """One hypothesis: its evidence, the best size's mode and how far things moved."""

    kind: CauseKind
    name: str
    log_evidence: float
    cell: Cell
    good: Array
    shift: tuple[float, float] = (np.nan, np.nan)
    turn: tuple[float, float] = (np.nan, np.nan)


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
    found = [_outliers(scene, S), _robot(scene, S, B, declared)]
    moves = [_Move.of(scene, observations, S, *part) for part in _parts(observations)]
    logs = [e.log_evidence for e in found] + [m.largest.log_evidence for m in moves]
    found += [move.averaged(scene, S, max(logs) - _NEGLIGIBLE) for move in moves]
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


def _outliers(scene: Scene, S: Array) -> _Explanation:
    mode = scene.mode(S, np.zeros((scene.chart.n, 0)))
    cell = scene.cell(scene.known @ mode.y)
    return _Explanation("outliers", "", mode.log_evidence, cell, mode.good)


def _robot(scene: Scene, S: Array, B: Array, declared: HandNoise) -> _Explanation:
    none = np.zeros((scene.chart.n, 0))
    modes: list[Mode] = []
    for size in ROBOT_NOISE[::-1]:
        more = size**2 * ROBOT_UNIT.variances
        noise = S + np.einsum("nij,j,nkj->nik", B, more, B)
        modes.append(scene.mode(noise, none, modes[-1].y if modes else None))
    log_evidence, weight = _averaged(modes, len(ROBOT_NOISE))
    best = modes[int(np.argmax(weight))]
    found: list[tuple[float, float]] = []
    for own, unit in zip(declared, ROBOT_UNIT, strict=True):
        sigma = np.hypot(own, ROBOT_NOISE[::-1] * unit)
        found.append(_moments(sigma, np.zeros_like(sigma), weight))
    cell = scene.cell(scene.known @ best.y)
    return _Explanation("robot", "", log_evidence, cell, best.good, found[0], found[1])


@dataclass(frozen=True, eq=False)
class _Move:
    """A part, and what a displacement of it by one standard deviation does at size one.

    ``basis`` (k, k): turns and shifts to tangent coordinates; ``unit`` (k,): `TURN_UNIT`, ...;
    ``middle`` (3,): see `change_basis`; ``largest``: mode for the largest of `SCALES`.
    """

    kind: Part
    name: str
    basis: Array
    unit: Array
    middle: Array
    D: Array
    largest: Mode

    @classmethod
    def of(cls, scene: Scene, observations: Observations, S: Array, kind: Part, name: str) -> _Move:
        """The mode is looked for from the old place and, where that fails, by `relocate`."""
        cell, columns = scene.belief.cell, scene.belief.columns(kind, name)
        middle = middle_of_spots(cell, observations, name) if kind == "plane" else np.zeros(3)
        basis = change_basis(cell, kind, name, middle)
        unit = np.full(len(basis), SHIFT_UNIT)
        unit[: TURNS[kind]] = TURN_UNIT
        D = np.zeros((scene.chart.n, len(basis)))
        D[columns] = basis * unit
        mode = scene.mode(S, SCALES[-1] * D, trusting=True)
        mine = getattr(observations, kind) == name
        if mode.good[mine].mean() < _EXPLAINED:
            start = _relocated(scene, observations[mine], S[mine], kind, name)
            if start is not None:
                b = np.linalg.solve(basis * unit, start[columns]) / SCALES[-1]
                y = np.concatenate([np.zeros(scene.known.shape[1]), b])
                other = scene.mode(S, SCALES[-1] * D, y)
                mode = max(mode, other, key=lambda m: m.log_density)
        return cls(kind, name, basis, unit, middle, D, mode)

    @property
    def bound(self) -> float:
        """No size has more evidence than this: the prior's density is largest for no move."""
        k = len(self.basis)
        b = self.largest.y[-k:]
        return float(self.largest.log_evidence + 0.5 * (b @ b) + k * np.log(SCALES[-1] / SCALES[0]))

    def averaged(self, scene: Scene, S: Array, least: float) -> _Explanation:
        """Evidence averaged over the sizes, and the displacement.

        Smaller sizes are left out where nothing of the kind reaches ``least``, or once they only
        get worse.
        """
        k = scene.known.shape[1]
        modes, scales = [self.largest], [float(SCALES[-1])]
        for scale in SCALES[-2::-1] if self.bound > least else ():
            start = modes[-1].y.copy()
            start[k:] *= scales[-1] / scale
            modes.append(scene.mode(S, scale * self.D, start))
            scales.append(float(scale))
            if modes[-1].log_evidence < max(m.log_evidence for m in modes) - _NEGLIGIBLE:
                break
        log_evidence, weight = _averaged(modes, len(SCALES))
        turns, shifts, turn_sigmas, shift_sigmas = np.zeros((4, len(modes)))
        t = TURNS[self.kind]
        for i in np.flatnonzero(weight > _NO_WEIGHT):
            mode, scale = modes[i], scales[i]
            before = scene.cell(scene.known @ mode.y[:k])
            turns[i], shifts[i] = change_between(
                before, self._after(scene, mode, scale), self.kind, self.name, self.middle
            )
            unit = scale * self.unit
            covariance = np.linalg.inv(mode.information)[k:, k:] * np.outer(unit, unit)
            local = unit * mode.y[k:]
            turn_sigmas[i] = _sigma_along(local[:t], covariance[:t, :t])
            shift_sigmas[i] = _sigma_along(local[t:], covariance[t:, t:])
        best = int(np.argmax(weight))
        return _Explanation(
            self.kind, self.name, log_evidence,
            self._after(scene, modes[best], scales[best]), modes[best].good,
            _moments(shifts, shift_sigmas, weight), _moments(turns, turn_sigmas, weight),
        )  # fmt: skip

    def _after(self, scene: Scene, mode: Mode, scale: float) -> Cell:
        k = scene.known.shape[1]
        return scene.cell(scene.known @ mode.y[:k] + scale * self.D @ mode.y[k:])


def _relocated(
    scene: Scene, observations: Observations, S: Array, kind: Part, name: str
) -> Array | None:
    """Chart coordinates of the cell with the part located anew; None where that fails."""
    cell, seen = scene.belief.cell, replace(observations, cov_uv=S)
    try:
        if kind == "camera":
            cameras = {**cell.cameras, name: locate_camera(cell, seen)}
            return coordinates(cell, replace(cell, cameras=cameras))
        if kind == "laser":
            lasers = {**cell.lasers, name: locate_laser(cell, seen)}
            return coordinates(cell, replace(cell, lasers=lasers))
        planes = {**cell.planes, name: locate_plane(cell, seen)}
        return coordinates(cell, replace(cell, planes=planes))
    except LasercalError:
        return None


def _averaged(modes: Sequence[Mode], sizes: int) -> tuple[float, Array]:
    """Log of the mean evidence over sizes with equal weights, and the modes' probabilities.

    Sizes without a mode have no evidence worth speaking of.
    """
    logs = np.array([mode.log_evidence for mode in modes])
    total = float(np.logaddexp.reduce(logs))
    return total - float(np.log(sizes)), np.exp(logs - total)


def _moments(values: Array, sigmas: Array, weight: Array) -> tuple[float, float]:
    """Mean and standard deviation of a mixture."""
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (sigmas**2 + (values - mean) ** 2)))


def _sigma_along(v: Array, covariance: Array) -> float:
    """Standard deviation of the length of ``v``; the largest one where ``v`` has none."""
    length = float(np.linalg.norm(v))
    if not length > 0:
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return float(np.sqrt(v @ covariance @ v)) / length


def _cause(e: _Explanation, probability: float, log_likelihood: float) -> Cause:
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
