"""`IncrementalCalibrator`: a calibration that goes on, spot by spot, for months."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.errors import DataError, DegenerateError
from lasercal_gtsam.history import HistoryRow
from lasercal_gtsam.incremental.alarms import looked_into
from lasercal_gtsam.incremental.beginning import (
    begun,
    better_solution,
    continued,
    determined,
    first_solution,
    holds_its_spots,
    too_few,
)
from lasercal_gtsam.incremental.belief import MOVABLE, Named, part_offset
from lasercal_gtsam.incremental.estimate import Estimate
from lasercal_gtsam.incremental.filter import Filter
from lasercal_gtsam.incremental.innovation import Innovation, innovations_of
from lasercal_gtsam.incremental.parts import (
    KINDS,
    Found,
    find_part,
    parts_of,
    relaid,
    with_part,
)
from lasercal_gtsam.incremental.result import Account, calibration_of, parameters_of
from lasercal_gtsam.incremental.settings import Settings
from lasercal_gtsam.incremental.store import HELD_BACK, LEFT_OUT, USED, SpotStore
from lasercal_gtsam.incremental.trace import Trace
from lasercal_gtsam.incremental.update import (
    Alarm,
    Event,
    EventKind,
    Missing,
    Phase,
    Rejection,
    Update,
)
from lasercal_gtsam.incremental.watchman import Watchman
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.robust import rejection_length

# growth between attempts to find a first solution, and between repetitions of it while few spots
# are there, up to this many
_ATTEMPT_GROWTH, _AUDIT_GROWTH, _AUDITED = 1.15, 1.33, 300
# a window is folded into the prior in pieces of this share of it
_FOLDED_SHARE = 1 / 8


class IncrementalCalibrator:
    """Re-calibration as spots arrive; each costs the same, whatever came before.

    Parameters
    ----------
    calibration : where to go on from. Its own spots are kept, so that the estimate stays that of
        all of them together; where it does not hold them (it was itself continued with forgetting),
        its covariance is the prior. None: begin with nothing, and collect spots until the closed
        form is possible
    options : as for `calibrate`; those of the calibration if left out
    automatic : act on an alarm whose cause is sure: free what has moved and go on
    max_spots : spots that are kept one by one; older ones live on as a Gaussian prior
    half_life : number of spots after which a spot counts half; None: spots never fade

    Notes
    -----
    Deterministic: the same calls give the same digits. Not for several threads at once.

    Raises
    ------
    DataError
        Options that contradict each other, or a calibration without sigmas.
    """

    def __init__(
        self,
        calibration: Calibration | None = None,
        options: CalibrationOptions | None = None,
        *,
        automatic: bool = False,
        max_spots: int | None = None,
        half_life: float | None = None,
    ) -> None:
        if options is None:
            options = CalibrationOptions() if calibration is None else calibration.options_used
        sigma_px = options.sigma_px or 1.0
        self._settings = Settings(options, automatic, max_spots, half_life, sigma_px)
        self._store = SpotStore({})
        self._filter: Filter | None = None
        self._watchman = Watchman(self._store, Cell({}, {}, {}), 0.0, 0.0)
        self._initial = Cell({}, {}, {})
        self._words: tuple[str, ...] = ()
        self._stops = False
        self._older = 0
        self._open: set[Named] = set()
        self._pending: list[int] = []
        self._missing: tuple[Missing, ...] = ()
        self._alarm: Alarm | None = None
        self._since = 0
        self._events: list[Event] = []
        self._reported = 0
        self._trace = Trace()
        self._next_attempt = self._next_audit = 0
        if calibration is not None:
            self._go_on_from(calibration)
        self._last = self._update(range(0), [])

    # --- reading --------------------------------------------------------------------------------

    @property
    def n_spots(self) -> int:
        """Spots given so far, those of the calibration it began with included."""
        return self._older + self._store.end

    @property
    def phase(self) -> Phase:
        """``collecting``, ``running`` or ``recovering``."""
        if self._filter is None:
            return "collecting"
        return "recovering" if self._open or self._missing else "running"

    @property
    def cell(self) -> Cell | None:
        """The estimate; None while collecting."""
        return None if self._filter is None else self._filter.estimate.cell

    @property
    def calibration(self) -> Calibration | None:
        """The whole result; None while collecting."""
        return self._last.calibration

    @property
    def alarm(self) -> Alarm | None:
        """An open alarm."""
        return self._alarm

    @property
    def missing(self) -> tuple[Missing, ...]:
        """What must come before everything can be estimated."""
        return self._missing

    @property
    def events(self) -> tuple[Event, ...]:
        """Everything that has happened."""
        return tuple(self._events)

    @property
    def history(self) -> tuple[HistoryRow, ...]:
        """The table at moments that grow rarer, at every event, and now."""
        return self._trace.rows(self._last)

    # --- what can be done -----------------------------------------------------------------------

    def add(self, observations: Observations) -> Update:
        """Take in new spots, one or thousands.

        Raises
        ------
        DataError
            A camera's image size differs from what it was.
        """
        self._check_sizes(observations)
        self._note_stops(observations)
        numbers = self._store.append(observations, self._settings.sigma_px)
        seen: list[Innovation | None] = [None] * len(numbers)
        if self._filter is None:
            self._collect()
        else:
            for i, number in enumerate(numbers):
                seen[i] = self._take(self._filter, number)
            if self._alarm is not None:
                self._examine(self._alarm)
            if self._alarm is None:
                self._extend()
                self._audit()
                self._let_go()
        self._last = self._update(numbers, seen)
        return self._last

    def _note_stops(self, observations: Observations) -> None:
        self._stops |= observations.stop is not None and bool((observations.stop != "").any())

    def reset(
        self, *, camera: str | None = None, laser: str | None = None, plane: str | None = None
    ) -> Update:
        """Forget where parts are, because they were moved, and keep all the rest.

        Of a camera its pose is freed; its intrinsics stay. With an alarm open, the spots since its
        beginning count as taken after the move; without one, the spots that come next do.

        Raises
        ------
        DataError
            No part is named, or one is unknown.
        DegenerateError
            There is no estimate yet.
        """
        cell = self._running().template
        named = zip(KINDS, (camera, laser, plane), strict=True)
        parts = [(kind, name) for kind, name in named if name is not None]
        if not parts:
            raise DataError("reset: say what has moved: camera=, laser= or plane=")
        for kind, name in parts:
            if name not in parts_of(cell, kind):
                known = ", ".join(parts_of(cell, kind))
                raise DataError(f"reset: {kind} {name!r} is not among {known}")
        self._free(parts)
        self._extend()
        self._last = self._update(range(0), [])
        return self._last

    def dismiss(self) -> Update:
        """Close an alarm: nothing has moved. The spots held back are used, as far as they fit."""
        if self._alarm is not None:
            self._end_alarm("resolved", "the alarm was dismissed: its spots are used")
            self._extend()
        self._last = self._update(range(0), [])
        return self._last

    # --- beginning ------------------------------------------------------------------------------

    def _collect(self) -> None:
        missing = too_few(self._store)
        if missing is None:
            seen = len(self._store)
            if seen < self._next_attempt:
                self._missing = (replace(self._missing[0], have=seen),)
                return
            self._next_attempt = int(np.ceil(_ATTEMPT_GROWTH * (seen + 1)))
            found = first_solution(self._store.observations(), self._settings.options)
            if isinstance(found, Calibration):
                self._begin(found, _start_words(found))
                return
            missing = found
        self._missing = (missing,)

    def _go_on_from(self, calibration: Calibration) -> None:
        self._settings = self._settings.informed_by(calibration)
        fit, spots = calibration.fit, calibration.inputs.observations
        self._note_stops(spots)
        if holds_its_spots(calibration):
            self._store.append(spots, self._settings.sigma_px)
            self._begin(calibration, _start_words(calibration))
            return
        self._older = fit.n_spots + fit.n_rejected
        self._store = SpotStore(dict(spots.image_size))
        self._run(continued(self._store, calibration, self._settings), calibration)
        self._note("started", f"from a calibration of {fit.n_spots} spots, by its covariance")

    def _begin(self, found: Calibration, words: str) -> None:
        self._settings = self._settings.informed_by(found)
        self._store.assume(self._settings.sigma_px)
        self._run(begun(self._store, found, self._settings), found)
        self._missing, self._next_audit = (), int(_AUDIT_GROWTH * len(self._store))
        self._note("started", words)

    def _run(self, filter: Filter, found: Calibration) -> None:
        self._filter = filter
        self._initial, self._words = found.initial, found.observability.held
        fit = found.fit if self._older else None  # else the store tells
        outliers, good = (fit.n_rejected, fit.n_spots) if fit else (0, 0)
        self._watchman = Watchman(self._store, filter.template, outliers, good)

    def _audit(self) -> None:
        """While there are few spots, see whether a fresh start from all of them ends better."""
        count = len(self._store)
        if not self._next_audit <= count <= _AUDITED or self._older or self._store.first:
            return
        self._next_audit = int(_AUDIT_GROWTH * count)
        if self._open or self._pending or self._settings.half_life is not None:
            return
        better = better_solution(self._store, self._running(), self._settings)
        if better is not None:
            self._begin(*better)

    # --- one spot -------------------------------------------------------------------------------

    def _take(self, filter: Filter, number: int) -> Innovation | None:
        """Compare a spot with what was expected; use it, leave it out, or hold it back."""
        camera, laser, plane, _ = self._store.path_of(number)
        cell = filter.template
        known = camera in cell.cameras and laser in cell.lasers and plane in cell.planes
        parts = {("camera", camera), ("laser", laser), ("plane", plane)}
        if not known or not parts.isdisjoint(self._open):
            self._pending.append(number)
            filter.use(number, number + 1)
            return None
        seen = filter.expect(number)
        since = None
        if self._alarm is None:
            since = self._watchman.look(number, self._store, filter, seen)
            if since is None:
                limit = rejection_length(filter.count + 1) if filter.robust else np.inf
                good = np.isfinite(seen.chi2) and seen.chi2 <= limit * limit
                mark = USED if good else LEFT_OUT
                self._store.mark(number, number + 1, mark)
        filter.use(number, number + 1, seen)
        if self._alarm is None and since is None:
            filter.settle()
        elif since is not None:
            self._raise_alarm(filter, since)
        return seen

    def _let_go(self) -> None:
        """Fold the oldest spots into the prior where there are more than are to be kept."""
        most = self._settings.max_spots
        if most is not None and len(self._store) >= most + max(1, int(_FOLDED_SHARE * most)):
            oldest = min(self._pending, default=self._store.end)
            self._running().fold(min(self._store.end - most, oldest))

    # --- alarms ---------------------------------------------------------------------------------

    def _raise_alarm(self, filter: Filter, since: int) -> None:
        self._since = max(since, self._store.first)
        filter.take_out(self._since, filter.end, HELD_BACK)
        label, number = self._store.label(self._since), self._older + self._since
        self._alarm = Alarm(label, number, 0, (), "")

    def _examine(self, alarm: Alarm) -> None:
        """Which cause explains the spots since the alarm best; act where that is sure."""
        self._alarm, cause = looked_into(
            alarm,
            self._since,
            self._store,
            self._running(),
            self._open,
            self._settings,
            self._watchman.outlier_rate,
        )
        if not alarm.words:
            self._note("alarm", self._alarm.words)
        if cause is None or cause.kind == "robot":
            return
        if cause.kind == "outliers":
            self._end_alarm("withdrawn", f"nothing has moved since spot {alarm.since}: outliers")
        elif self._settings.automatic:
            self._free([(cause.kind, cause.name)], cause.words)

    def _end_alarm(self, kind: EventKind, words: str) -> None:
        """Take the spots that were held back as they are."""
        self._alarm = None
        waiting = set(self._pending)
        self._use(n for n in range(self._since, self._store.end) if n not in waiting)
        self._watchman.forgive()
        self._note(kind, words)

    # --- parts that move, and new ones ----------------------------------------------------------

    def _free(self, parts: Sequence[Named], why: str = "") -> None:
        """Turn older spots into prior knowledge, in which these parts are then forgotten."""
        filter = self._running()
        onset = self._store.end if self._alarm is None else self._since
        filter.fold(onset)
        for kind, name in parts:
            at = part_offset(filter.template, kind, name)
            filter.forget_part(slice(at, at + MOVABLE[kind]))
            self._open.add((kind, name))
        given_up = sum(number < onset for number in self._pending)
        self._pending = list(range(onset, self._store.end))
        self._alarm = None
        self._watchman.forgive(onset)
        self._use_ready()
        named = " and ".join(f"{kind} {name!r}" for kind, name in parts)
        words = f"{why}; freed" if why else f"{named} freed"
        if given_up:
            words += f"; {given_up} spots that waited since before are given up"
        self._note("reset", words)

    def _extend(self) -> None:
        """Find parts that are new or freed, as far as the spots that wait determine them."""
        self._missing = ()
        while self._pending or self._open:
            waiting = self._store.chosen(self._pending) if self._pending else None
            cell = self._running().estimate.cell
            found = find_part(cell, self._unknown_parts(waiting, cell), waiting)
            if not isinstance(found, Found):
                self._missing = tuple(found)
                return
            self._place(*found)

    def _unknown_parts(self, waiting: Observations | None, cell: Cell) -> list[Named]:
        """Parts that are freed, then those new ones that spots wait for."""
        unknown = sorted(self._open)
        for kind in KINDS if waiting is not None else ():
            names = getattr(waiting, f"{kind}s")
            unknown += [(kind, name) for name in names if name not in parts_of(cell, kind)]
        return unknown

    def _place(self, part: Named, value: Camera | Beam | Plane) -> None:
        """Take in a part that was located, and the spots that waited for it alone."""
        old, (kind, name) = self._running(), part
        is_new = name not in parts_of(old.template, kind)
        if is_new:
            self._initial = with_part(self._initial, part, value)
        elif isinstance(value, Camera):
            # the chart's intrinsics stay where the prior's coordinates begin
            value = replace(old.template.cameras[name], T_base_camera=value.T_base_camera)
        cell = with_part(old.template, part, value)
        self._open.discard(part)
        self._filter, words = relaid(old, cell, part, self._settings.options)
        self._words = self._words if words is None else words
        self._watchman.cover(cell)
        self._use_ready()
        kinds: tuple[EventKind, EventKind] = ("extended", "recovered")
        self._note(kinds[not is_new], f"{kind} {name!r} found{'' if is_new else ' again'}")

    def _use_ready(self) -> None:
        """Use the spots that wait for nothing any more."""
        if self._pending:
            spots = self._store.chosen(self._pending)
            good = determined(spots, self._running().template, self._open)
            ready = [n for n, is_ready in zip(self._pending, good, strict=True) if is_ready]
            self._pending = sorted(set(self._pending) - set(ready))
            self._use(ready)

    def _use(self, numbers: Iterable[int]) -> None:
        """Use spots that were held back, as far as they fit; everything is relinearised."""
        for number in numbers:
            self._store.mark(number, number + 1, USED)
        self._running().relinearise()

    # --- answers --------------------------------------------------------------------------------

    def _running(self) -> Filter:
        if self._filter is None:
            why = self._missing[0].words if self._missing else "there are no spots"
            raise DegenerateError(f"there is no estimate yet: {why}")
        return self._filter

    def _check_sizes(self, observations: Observations) -> None:
        for name, size in observations.image_size.items():
            known = self._store.image_size.get(name, size)
            if known != size:
                raise DataError(
                    f"camera {name!r} had image size {known} so far; these spots say {size}. "
                    "A camera that was set up differently needs another name"
                )

    def _note(self, kind: EventKind, words: str) -> None:
        self._events.append(Event(kind, self.n_spots, words))

    def _update(self, numbers: range, seen: Sequence[Innovation | None]) -> Update:
        estimate = None if self._filter is None else self._filter.estimate
        labels = [self._store.label(number) for number in numbers]
        marks = [self._store.mark_of(number) for number in numbers]
        events = tuple(self._events[self._reported :])
        self._reported = len(self._events)
        initial = self._initial
        update = Update(
            phase=self.phase,
            accepted=tuple(x for x, mark in zip(labels, marks, strict=True) if mark == USED),
            rejected=tuple(
                Rejection(label, self._reason(one))
                for label, mark, one in zip(labels, marks, seen, strict=True)
                if mark == LEFT_OUT
            ),
            held_back=tuple(x for x, mark in zip(labels, marks, strict=True) if mark == HELD_BACK),
            alarm=self._alarm,
            missing=self._missing,
            events=events,
            n_spots=self.n_spots,
            n_used=0 if estimate is None else round(estimate.weight),
            sigma0=float("nan") if estimate is None else self._settings.unit * estimate.sigma0,
            rms_px=float("nan") if estimate is None else estimate.rms_px,
            _innovation=lambda: innovations_of(labels, seen),
            _cell=lambda: None if estimate is None else estimate.cell,
            _parameters=lambda: () if estimate is None else parameters_of(estimate, initial),
            _calibration=self._answer(estimate),
        )
        self._trace.record(update)
        return update

    def _reason(self, seen: Innovation | None) -> str:
        limit = self._running().limit / self._running().scale
        if seen is None or not np.isfinite(seen.chi2):
            return "no spot can be there"
        return f"{np.sqrt(seen.chi2):.1f} sigma from where it was expected, limit {limit:.1f}"

    def _answer(self, estimate: Estimate | None) -> Callable[[], Calibration | None]:
        """The whole result as it stands now, to be made when somebody asks."""
        if estimate is None or self._filter is None:
            return lambda: None
        store, first, end, older = self._store, self._store.first, self._store.end, self._older
        settings, limit = self._settings, self._filter.limit
        initial, words, missing, alarm = self._initial, self._words, self._missing, self._alarm
        if self._stops and max(self._settings.hand) > 0:
            words = (*words, _STOPS_APART)
        waiting = (*self._pending, *range(self._since, end)) if alarm else tuple(self._pending)

        def make() -> Calibration:
            begin = max(first, store.first)
            troubles = [m.words for m in missing] + ([] if alarm is None else [alarm.words])
            account = Account(
                initial=initial,
                options=settings.options,
                sigma_px=settings.sigma_px,
                limit=limit,
                waiting=waiting,
                older=older + first,
                words=words,
                troubles=tuple(troubles),
                fade=settings.weighing.fade,
            )
            spots = store.observations(begin, end)
            return calibration_of(estimate, spots, begin, account, settings.unit)

        return make


_STOPS_APART = (
    "spots of one stop count here as if each had an error of the hand of its own, so that the "
    "sigmas are somewhat too small: 'lasercal calibrate' takes them together"
)


def _start_words(found: Calibration) -> str:
    return f"with {found.fit.n_spots} spots, RMS {found.fit.rms_px:.3g} px"
