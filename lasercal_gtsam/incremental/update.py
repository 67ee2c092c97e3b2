"""What a new spot has changed: the answer of `IncrementalCalibrator.add`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from lasercal_gtsam.calibration import Calibration, Parameter
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Names

Phase = Literal["collecting", "running", "recovering"]
CauseKind = Literal["camera", "laser", "plane", "robot", "outliers"]
EventKind = Literal["started", "extended", "alarm", "withdrawn", "reset", "recovered", "resolved"]


@dataclass(frozen=True, eq=False)
class Innovations:
    """How far each new spot lies from where it was expected, before it was used.

    Attributes
    ----------
    id : (N,) labels
    residual_px : (N, 2) predicted minus seen pixel; NaN where nothing could be predicted (no
        estimate yet, a part that is new, no spot possible)
    covariance_px2 : (N, 2, 2) covariance of that residual: the estimate's and the spot's own noise
    chi2 : (N,) ``residual^T covariance^-1 residual``, 2 degrees of freedom
    """

    id: Names
    residual_px: Array
    covariance_px2: Array
    chi2: Array

    def __len__(self) -> int:
        return len(self.chi2)


@dataclass(frozen=True)
class Rejection:
    """A spot that the estimate does not use, and why."""

    id: str
    reason: str


@dataclass(frozen=True)
class Missing:
    """One thing that must be supplied before (a part of) the cell can be estimated.

    Attributes
    ----------
    part : ``"cell"``, ``"camera"``, ``"laser"`` or ``"plane"``
    name : which one; "" for the cell
    have, need : spots there are and spots there should be, at least
    words : what is missing and what would supply it, one sentence
    """

    part: Literal["cell", "camera", "laser", "plane"]
    name: str
    have: int
    need: int
    words: str


@dataclass(frozen=True)
class Cause:
    """One explanation of spots that do not fit, with its evidence.

    Attributes
    ----------
    kind : what happened: ``camera``, ``laser`` or ``plane`` moved, ``robot`` (worse than declared),
        or ``outliers`` (a few bad spots, nothing moved)
    name : which camera, laser or plane; "" otherwise
    probability : posterior among all causes looked at
    log_likelihood : natural logarithm of the evidence, relative to ``outliers``
    shift_mm, sigma_mm : how far it moved and how well that is known; camera: its centre; laser: the
        beam's point nearest to the hand's origin; plane: along its normal, where the spots are;
        robot: translation sigma that would explain the spots; NaN for ``outliers``
    turn_deg, sigma_deg : the same for the rotation
    words : one sentence
    """

    kind: CauseKind
    name: str
    probability: float
    log_likelihood: float
    shift_mm: float
    sigma_mm: float
    turn_deg: float
    sigma_deg: float
    words: str


@dataclass(frozen=True)
class Alarm:
    """Something is no longer as it was.

    Attributes
    ----------
    since : label of the first spot that was affected
    since_number : how many spots came before it
    spots : how many spots have come since, that one included
    causes : explanations, the most likely first; empty where none could be judged
    words : one sentence for the engineer
    """

    since: str
    since_number: int
    spots: int
    causes: tuple[Cause, ...]
    words: str

    @property
    def cause(self) -> Cause | None:
        """The most likely explanation; None where none could be judged."""
        return self.causes[0] if self.causes else None


@dataclass(frozen=True)
class Event:
    """Something worth remembering: a start, an alarm, a reset.

    ``spots`` is the number of spots given so far.
    """

    kind: EventKind
    spots: int
    words: str


@dataclass(frozen=True, eq=False)
class Update:
    """The state after some spots were added.

    Attributes
    ----------
    phase : ``collecting`` (no estimate yet), ``running``, or ``recovering`` (a part was reset, or
        is new, and is not determined yet; the rest is)
    accepted : labels of the new spots that the estimate uses
    rejected : new spots that it does not use, with reasons
    held_back : labels of new spots that wait: for more of their kind, or for an alarm's outcome
    alarm : an open alarm, or None
    missing : what must come before everything can be estimated; empty when all is
    events : what happened in this update
    n_spots : spots given so far, all of them
    n_used : spots in the estimate
    sigma0 : residual scale, as `Fit.sigma0`; NaN while collecting
    rms_px : residual RMS over the spots used, to the linearisation; NaN while collecting
    """

    phase: Phase
    accepted: tuple[str, ...]
    rejected: tuple[Rejection, ...]
    held_back: tuple[str, ...]
    alarm: Alarm | None
    missing: tuple[Missing, ...]
    events: tuple[Event, ...]
    n_spots: int
    n_used: int
    sigma0: float
    rms_px: float
    _innovation: Callable[[], Innovations] = field(repr=False)
    _cell: Callable[[], Cell | None] = field(repr=False)
    _parameters: Callable[[], tuple[Parameter, ...]] = field(repr=False)
    _calibration: Callable[[], Calibration | None] = field(repr=False)

    @cached_property
    def innovation(self) -> Innovations:
        """How the new spots compare with what was expected of them."""
        return self._innovation()

    @cached_property
    def cell(self) -> Cell | None:
        """The estimate as it stood after this update; None while collecting."""
        return self._cell()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Rows of the table with sigmas as they stood after this update; empty while collecting."""
        return self._parameters()

    @cached_property
    def calibration(self) -> Calibration | None:
        """The whole result as it stood after this update; None while collecting.

        Made when first asked for: it holds the account of every spot.
        """
        return self._calibration()

    @property
    def words(self) -> str:
        """One line: what is known, and what is wrong or missing."""
        if self.phase == "collecting":
            line = f"{self.n_spots} spots, collecting"
        else:
            line = f"{self.n_spots} spots, {self.n_used} used, RMS {self.rms_px:.3g} px"
        parts = [line, *(m.words for m in self.missing)]
        if self.alarm is not None:
            parts.append(self.alarm.words)
        return "; ".join(parts)
