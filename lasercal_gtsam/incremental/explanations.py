"""The explanations of spots that do not fit: bad spots, a worse robot, a part that has moved.

Each turns into one model of `evidence` or several, for the sizes it may have, and says how far
things have moved if it is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.hand_noise import HandNoise
from lasercal_gtsam.incremental.belief import Part, coordinates
from lasercal_gtsam.incremental.change import (
    TURNS,
    change_basis,
    change_between,
    middle_of_spots,
)
from lasercal_gtsam.incremental.evidence import Mode, Scene
from lasercal_gtsam.incremental.recover import relocated
from lasercal_gtsam.incremental.update import CauseKind
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

SCALES = np.geomspace(1.0, 200.0, 8)
"""Sizes of displacements, in units of `TURN_UNIT` and `SHIFT_UNIT`: 0.1 deg, 0.5 mm to 20, 100."""
TURN_UNIT, SHIFT_UNIT = 0.1 * RAD_PER_DEG, 0.5 * M_PER_MM
ROBOT_NOISE = np.geomspace(0.1, 12.8, 8)
"""Sizes of additional hand noise, in units of `ROBOT_UNIT`."""
ROBOT_UNIT = HandNoise(1.0 * M_PER_MM, 0.1 * RAD_PER_DEG)
NEGLIGIBLE = 20.0
"""Difference of log evidence from which on an explanation no longer matters."""
# a probability of a size that no longer matters
_NO_WEIGHT = 1e-4
# squared length, beyond what is expected, from which on a displacement is unlikely at its size
_FAR = 9.0
# a mode explains the spots if no more than the rest of them count as outliers
_EXPLAINED = 0.8
# times that the gaps beside the best robot noise are halved
_ROBOT_REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class Explanation:
    """One hypothesis: its evidence, the best size's mode and how far things moved."""

    kind: CauseKind
    name: str
    log_evidence: float
    cell: Cell
    good: Array
    shift: tuple[float, float] = (np.nan, np.nan)
    turn: tuple[float, float] = (np.nan, np.nan)


def bad_spots(scene: Scene, S: Array) -> Explanation:
    """Nothing has changed."""
    mode = scene.mode(S, np.zeros((scene.chart.n, 0)))
    cell = scene.cell(scene.known @ mode.y)
    return Explanation("outliers", "", mode.log_evidence, cell, mode.good)


def worse_robot(scene: Scene, S: Array, B: Array, declared: HandNoise) -> Explanation:
    """Additional hand noise, averaged over its size: uniform in the logarithm over the range.

    Many spots tell the size to a few per cent, so that sizes are added around the best one.
    """
    none = np.zeros((scene.chart.n, 0))
    unit = np.einsum("nij,j,nkj->nik", B, ROBOT_UNIT.variances, B)
    modes: dict[float, Mode] = {}

    def look(size: float, start: Array | None) -> None:
        modes[size] = scene.mode(S + size**2 * unit, none, start)

    def best() -> float:
        return max(modes, key=lambda size: modes[size].log_evidence)

    for size in ROBOT_NOISE[::-1].tolist():
        look(size, modes[min(modes)].y if modes else None)
        if modes[size].log_evidence < modes[best()].log_evidence - NEGLIGIBLE:
            break
    for _ in range(_ROBOT_REFINEMENTS):
        sizes, middle = np.array(sorted(modes)), best()
        near = np.flatnonzero(sizes == middle)[0]
        for other in sizes[max(near - 1, 0) : near + 2]:
            if other != middle:
                look(float(np.sqrt(other * middle)), modes[middle].y)
    sizes = np.array(sorted(modes))
    logs = np.array([modes[size].log_evidence for size in sizes.tolist()])
    widths = np.gradient(np.log(sizes)) if len(sizes) > 1 else np.ones(1)
    logs += np.log(widths / np.log(ROBOT_NOISE[-1] / ROBOT_NOISE[0]))
    log_evidence = float(np.logaddexp.reduce(logs))
    weight = np.exp(logs - log_evidence)
    found: list[tuple[float, float]] = []
    for own, one in zip(declared, ROBOT_UNIT, strict=True):
        sigma = np.hypot(own, sizes * one)
        found.append(_moments(sigma, np.zeros_like(sigma), weight))
    chosen = modes[best()]
    cell = scene.cell(scene.known @ chosen.y)
    return Explanation("robot", "", log_evidence, cell, chosen.good, found[0], found[1])


@dataclass(frozen=True, eq=False)
class Move:
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
    def of(cls, scene: Scene, observations: Observations, S: Array, kind: Part, name: str) -> Move:
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
            for other_cell in relocated(cell, observations[mine], S[mine], kind, name):
                try:
                    z = coordinates(cell, other_cell)
                except LasercalError:  # turned by 90 deg or more: no place to move to
                    continue
                b = np.linalg.solve(basis * unit, z[columns]) / SCALES[-1]
                y = np.concatenate([np.zeros(scene.known.shape[1]), b])
                other = scene.mode(S, SCALES[-1] * D, y)
                mode = max(mode, other, key=lambda m: m.log_density)
        return cls(kind, name, basis, unit, middle, D, mode)

    @property
    def bound(self) -> float:
        """No size has more evidence: its prior is nowhere denser than the largest's by more."""
        k = len(self.basis)
        return float(self.largest.log_evidence + k * np.log(SCALES[-1] / SCALES[0]))

    def averaged(self, scene: Scene, S: Array, least: float) -> Explanation:
        """Evidence averaged over the sizes, and the displacement.

        Smaller sizes are left out where nothing of the kind reaches ``least``, or once they only
        get worse.
        """
        k = scene.known.shape[1]
        modes, scales = [self.largest], [float(SCALES[-1])]
        for scale in SCALES[-2::-1] if self.bound > least else ():
            start = modes[-1].y.copy()
            start[k:] *= scales[-1] / scale
            mode, b = scene.mode(S, scale * self.D, start), start[k:]
            if b @ b > len(b) + _FAR:
                # the mode is an unlikely one by now: there may be another near the old place
                other = scene.mode(S, scale * self.D, trusting=True)
                mode = max(mode, other, key=lambda m: m.log_evidence)
            modes.append(mode)
            scales.append(float(scale))
            if modes[-1].log_evidence < max(m.log_evidence for m in modes) - NEGLIGIBLE:
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
            turn_sigmas[i] = _length_sigma(local[:t], covariance[:t, :t])
            shift_sigmas[i] = _length_sigma(local[t:], covariance[t:, t:])
        best = int(np.argmax(weight))
        return Explanation(
            self.kind, self.name, log_evidence,
            self._after(scene, modes[best], scales[best]), modes[best].good,
            _moments(shifts, shift_sigmas, weight), _moments(turns, turn_sigmas, weight),
        )  # fmt: skip

    def _after(self, scene: Scene, mode: Mode, scale: float) -> Cell:
        k = scene.known.shape[1]
        return scene.cell(scene.known @ mode.y[:k] + scale * self.D @ mode.y[k:])


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


def _length_sigma(v: Array, covariance: Array) -> float:
    """Uncertainty of the length of ``v``.

    Along it to first order, and by how much what is across may make it longer: that counts where
    ``v`` is short against its own sigmas.
    """
    length = float(np.linalg.norm(v))
    if length > 0:
        along = float(v @ covariance @ v) / length**2
    else:
        along = float(np.linalg.eigvalsh(covariance)[-1])
    across = max(float(np.trace(covariance)) - along, 0.0)
    return float(np.hypot(np.sqrt(along), np.hypot(length, np.sqrt(across)) - length))
