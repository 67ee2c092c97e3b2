"""What the spots of a calibration determine weakly, why, and what would cure it.

The weak directions are those of the range-scaled information (`observability`). A direction is
named by the parts that move together in it; every remedy is judged by the information that it would
add along just that direction, computed at the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.check.causes import Cause, causes_of
from lasercal_gtsam.check.remedies import Remedy, remedies
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CellGraph, make_batch, make_graph, state_from_cell
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observability import WEAK, RangeSvd
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES, CalibrationOptions
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.solve import fold_warnings

Mask = npt.NDArray[np.bool_]

POOR = 0.8 * WEAK
"""Strength below which the geometry is called weak; the paper's own smallest tests lie above."""
CURED = 1.5 * WEAK
"""Strength that a remedy must reach: with a margin, for the estimate is not exact."""
_EXACT_PX = 1e-6
_SHARE = 0.12
_MOST_NAMED = 3


@dataclass(frozen=True)
class Cure:
    """A remedy for a weak direction.

    Attributes
    ----------
    kind : ``turn``, ``plane``, ``spread`` or ``repeat``
    cause : the fact of the geometry behind it, with numbers
    words : what to do
    strength : what the direction's strength would then be
    """

    kind: str
    cause: str
    words: str
    strength: float


@dataclass(frozen=True)
class Weakness:
    """A direction that the spots hardly determine.

    Attributes
    ----------
    strength : information along it in units of the plausible range, below 1
    what : the parts that move together, in words
    amounts : the direction with numbers and units
    cures : what would raise the strength above 1, the most fitting first; or, if nothing tried
        would, the best that was tried
    distortion : it is there only because the distortion is estimated too
    """

    strength: float
    what: str
    amounts: str
    cures: tuple[Cure, ...]
    distortion: bool = False

    @property
    def words(self) -> str:
        """One sentence: what, why, and what to do."""
        first = self.cures[0]
        text = f"{self.what}: {first.cause}; {first.words}"
        if first.strength < WEAK:
            return f"{text}, which alone is not enough"
        return text


def weaknesses(calibration: Calibration) -> tuple[Weakness, ...]:
    """Weak directions of a calibration, weakest first: of the geometry, then of the distortion.

    Directions that vanish when the distortion is held are listed apart: there the distortion is
    weak, not the geometry.
    """
    seen, options = calibration.inputs.observations, calibration.inputs.options
    used = seen[calibration.spots.weight > 0]
    sizes = np.sqrt(np.maximum(np.diag(calibration.covariance), 0.0))
    held = frozenset(
        label for label, size in zip(calibration.labels, sizes, strict=True) if size == 0.0
    )
    bench = _Bench(used, options, _ordered(calibration.cell, used), held)
    rigid = replace(
        bench,
        held=held
        | {label for label in calibration.labels if label.rpartition(".")[2] in DISTORTION_NAMES},
    )
    return (*rigid.weaknesses(POOR, distortion=False), *_beyond(bench, rigid))


def _beyond(bench: _Bench, rigid: _Bench) -> tuple[Weakness, ...]:
    """Weak directions with the distortion free that do not lie in the weak ones without it."""
    if rigid.held == bench.held:
        return ()
    count = len(rigid.svd().weak_directions(WEAK))
    return bench.weaknesses(WEAK, distortion=True)[count:]


def _ordered(cell: Cell, observations: Observations) -> Cell:
    return Cell(
        {name: cell.cameras[name] for name in observations.cameras},
        {name: cell.lasers[name] for name in observations.lasers},
        {name: cell.planes[name] for name in observations.planes},
    )


@dataclass(frozen=True, eq=False)
class _Bench:
    """Information of a set of spots at a cell, and of the same with more spots.

    Attributes
    ----------
    observations, options, cell : what was calibrated, and the estimate
    held : labels of the coordinates that are not free
    unit : factor on the a-priori pixel sigmas; None: by the residuals
    """

    observations: Observations
    options: CalibrationOptions
    cell: Cell
    held: frozenset[str]
    unit: float | None = None

    def svd(self) -> RangeSvd:
        """Information of the spots, in sigmas and plausible ranges."""
        problem, labels = self._problem()
        free = problem.free & np.array([label not in self.held for label in labels])
        rows = problem.rows(problem.start_values())
        return RangeSvd.of(rows, labels, free)

    def _problem(self) -> tuple[CellGraph, tuple[str, ...]]:
        holds = resolve_holds(self.observations, self.options)
        batch = make_batch(self.observations, self.options.sigma_px)
        problem = make_graph(self.observations, batch, holds, self.cell).anchored(self.cell)
        return problem.rescaled(self.unit or self.residual_unit()), tangent_labels(problem.start)

    def residual_unit(self) -> float:
        """Sigma of the whitened residuals; 1 where the data are exact."""
        batch = make_batch(self.observations, self.options.sigma_px)
        lengths = batch.whitened_lengths(state_from_cell(self.cell))
        labels = tangent_labels(self.cell)
        dof = 2 * len(lengths) - sum(label not in self.held for label in labels)
        scale = float(np.sqrt(np.nansum(lengths**2) / max(dof, 1)))
        return scale if scale > _EXACT_PX else 1.0

    def with_more(self, remedy: Remedy) -> _Bench:
        """The same with a remedy's shots; a new plane may free what one plane held."""
        together = self.observations + remedy.shots
        several = len(together.planes) > len(self.observations.planes) == 1
        held = frozenset(
            label
            for label in self.held
            if not (several and label.rpartition(".")[2] in ("u0", "v0", "skew"))
        )
        cell = _ordered(remedy.cell, together)
        return _Bench(together, self.options, cell, held, self.unit or self.residual_unit())

    def strength(self, labels: tuple[str, ...], direction: Array) -> float:
        """Strength along a direction given in plausible ranges of these labels."""
        svd = self.svd()
        d = np.zeros(len(svd.labels))
        for label, share in zip(labels, direction, strict=True):
            d[svd.labels.index(label)] = share
        spread = (svd.directions @ d) / np.maximum(svd.values, 1e-12)
        return float(1.0 / np.linalg.norm(spread))

    def weaknesses(self, threshold: float, distortion: bool) -> tuple[Weakness, ...]:
        """Directions with a strength below the threshold, weakest first, with their cures."""
        svd = self.svd()
        weak = svd.weak_directions(threshold)
        if not weak:
            return ()
        tried: dict[str, tuple[str, list[_Bench]]] = {}
        for remedy in remedies(_without_folds(self.cell), self.observations):
            tried.setdefault(remedy.words, (remedy.kind, []))[1].append(self.with_more(remedy))
        causes = causes_of(self.cell, self.observations)
        found = []
        for rank, direction in enumerate(weak):
            move = svd.directions[len(svd.labels) - 1 - rank]
            cures = list[Cure]()
            for words, (kind, benches) in tried.items():
                # whatever the advice leaves open must not matter: the worst way counts
                worst = min(bench.strength(svd.labels, move) for bench in benches)
                cures.append(Cure(kind, causes[kind].words, words, worst))
            # as many shots again double the information
            again = f"add {len(self.observations)} shots like those there are"
            cures.append(
                Cure("repeat", causes["repeat"].words, again, math.sqrt(2.0) * direction.strength)
            )
            found.append(
                Weakness(
                    direction.strength,
                    parts_in_words(svd.labels, move),
                    direction.words,
                    _chosen(cures, causes),
                    distortion,
                )
            )
        return tuple(found)


def _without_folds(cell: Cell) -> Cell:
    """The cell to plan shots with: a distortion that folds inside the picture is taken as none.

    That is what a distortion looks like which the spots do not determine.
    """
    if not fold_warnings(cell):
        return cell
    cameras = {
        name: replace(
            camera, intrinsics=replace(camera.intrinsics, **dict.fromkeys(DISTORTION_NAMES, 0.0))
        )
        for name, camera in cell.cameras.items()
    }
    return Cell(cameras, cell.lasers, cell.planes)


def _chosen(cures: list[Cure], causes: dict[str, Cause]) -> tuple[Cure, ...]:
    """Of each kind the easiest that cures, those first whose cause is there; else the strongest."""
    enough: dict[str, Cure] = {}
    for cure in cures:
        if cure.strength >= CURED:
            enough.setdefault(cure.kind, cure)
    if not enough:
        return (max(cures, key=lambda cure: cure.strength),)
    repeat = enough.pop("repeat", None)
    ranked = sorted(enough.values(), key=lambda cure: (not causes[cure.kind].poor, -cure.strength))
    return (*ranked, *([repeat] if repeat is not None else []))


_PARTS = {
    "rot_x": "camera rotation", "rot_y": "camera rotation", "rot_z": "camera rotation",
    "trans_x": "camera position", "trans_y": "camera position", "trans_z": "camera depth",
    "fu": "focal length", "fv": "focal length", "skew": "skew",
    "u0": "principal point", "v0": "principal point",
    "k1": "radial distortion", "k2": "radial distortion",
    "p1": "tangential distortion", "p2": "tangential distortion",
    "slope_a": "laser direction", "slope_b": "laser direction",
    "offset_x": "laser position", "offset_y": "laser position",
    "normal_1": "tilt", "normal_2": "tilt", "distance": "distance",
}  # fmt: skip


def parts_in_words(labels: tuple[str, ...], direction: Array) -> str:
    """``camera depth against focal length``: the parts that a direction moves together."""
    shares: dict[str, float] = {}
    for label, value in zip(labels, direction, strict=True):
        owner, _, name = label.rpartition(".")
        part = _PARTS[name]
        part = f"{part} of {owner}" if owner.startswith("plane ") else part
        shares[part] = shares.get(part, 0.0) + float(value) ** 2
    ranked = sorted(shares, key=lambda part: -shares[part])
    named = [part for part in ranked if shares[part] >= _SHARE][:_MOST_NAMED]
    if len(named) == 1:
        return f"{named[0]}"
    return f"{named[0]} against {' and '.join(named[1:])}"
