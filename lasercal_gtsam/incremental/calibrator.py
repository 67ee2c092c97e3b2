"""`IncrementalCalibrator`: a calibration that goes on, spot by spot, for months."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from lasercal_factors.stream_kernels import Weighing

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.closed_form.requirements import spots_needed
from lasercal_gtsam.errors import DataError, DegenerateError, LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import pixel_covariances
from lasercal_gtsam.hand_noise import HandNoise
from lasercal_gtsam.history import HistoryRow
from lasercal_gtsam.holds import Holds, resolve_holds
from lasercal_gtsam.incremental.belief import (
    Belief,
    Mask,
    Part,
    calibrated_parts,
    part_offset,
    tied_aspects,
)
from lasercal_gtsam.incremental.detector import Detector, Look
from lasercal_gtsam.incremental.diagnosis import diagnose
from lasercal_gtsam.incremental.filter import Estimate, Filter
from lasercal_gtsam.incremental.innovation import Innovation, innovations_of
from lasercal_gtsam.incremental.parts import (
    KINDS,
    located,
    soft_priors,
    with_part,
    without_parts,
)
from lasercal_gtsam.incremental.relocate import missing_for
from lasercal_gtsam.incremental.result import Account, calibration_of, parameters_of
from lasercal_gtsam.incremental.store import HELD_BACK, LEFT_OUT, USED, SpotStore
from lasercal_gtsam.incremental.update import (
    Alarm,
    Event,
    EventKind,
    Missing,
    Phase,
    Rejection,
    Update,
)
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES, CalibrationOptions
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.robust import rejection_length

# degrees of freedom before a first solution counts, and growth between attempts to find one
_FIRST_DOF, _FIRST_SPOTS, _ATTEMPT_GROWTH = 20, 15, 1.05
# a cause this probable is acted on: by itself if it is "outliers", else where that is wanted
_SURE = 0.99
# spots behind an alarm that must be there before anything is done by itself, up to which it is
# looked into at each spot, then at every fifth, and up to which at all
_FEWEST, _AT_EACH, _DIAGNOSED = 6, 20, 40
# spots after which "outliers" need only be more probable than all else together: a small shift
# can never be excluded, and is noticed again if it is there
_LONG_ENOUGH = 15
# while there are few spots, closed form and search are repeated at this growth, up to this many
_AUDIT_GROWTH, _AUDITED = 1.33, 300
_TOLD_APART = 9.0
# looks of the detector whose spots are remembered (its own window is shorter)
_REMEMBERED_LOOKS = 4096
# history: a row for each spot up to the first number, then at this growth
_EVERY_SPOT, _HISTORY_GROWTH = 200, 1.01
# a window is folded into the prior in pieces of this share of it
_FOLDED_SHARE = 1 / 8
_SIZES: dict[str, int] = {"camera": 6, "laser": 4, "plane": 3}


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
        if max_spots is not None and not max_spots >= 50:
            raise DataError(f"max_spots: expected 50 or more, got {max_spots!r}")
        if half_life is not None and not half_life >= 10:
            raise DataError(f"half_life: expected 10 spots or more, got {half_life!r}")
        if options is None:
            options = CalibrationOptions() if calibration is None else calibration.inputs.options
        self._options, self._automatic = options, automatic
        self._max_spots = max_spots
        self._fade = 1.0 if half_life is None else 0.5 ** (1.0 / half_life)
        self._sigma_px, self._unit = options.sigma_px or 1.0, 1.0
        self._store = SpotStore({})
        self._filter: Filter | None = None
        self._detector = Detector.start()
        self._looked_at: deque[int] = deque(maxlen=_REMEMBERED_LOOKS)
        self._initial = Cell({}, {}, {})
        self._words: tuple[str, ...] = ()
        self._older = self._used_before = 0
        self._next_attempt = 0
        self._priors: dict[str, tuple[float, float]] = {}
        self._open: set[tuple[Part, str]] = set()
        self._pending: list[int] = []
        self._alarm: Alarm | None = None
        self._since = 0
        self._events: list[Event] = []
        self._reported = 0
        self._history: list[Update] = []
        self._next_row, self._next_audit = 0, 0
        self._missing: tuple[Missing, ...] = ()
        if calibration is not None:
            self._continue_from(calibration)
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
        """The table at moments that grow rarer, and at every event."""
        return tuple(
            HistoryRow(
                u.n_spots, u.rms_px, u.sigma0, u.parameters, tuple(e.words for e in u.events)
            )
            for u in self._history
        )

    # --- spots ----------------------------------------------------------------------------------

    def add(self, observations: Observations) -> Update:
        """Take in new spots, one or thousands.

        Raises
        ------
        DataError
            A camera's image size differs from what it was.
        """
        self._check_sizes(observations)
        cov_uv = pixel_covariances(observations, self._sigma_px)
        numbers = self._store.append(observations, cov_uv)
        looks: list[Innovation | None] = [None] * len(numbers)
        if self._filter is None:
            self._collect()
        else:
            for i, number in enumerate(numbers):
                looks[i] = self._take(self._filter, number)
            if self._alarm is not None:
                self._examine()
            if self._alarm is None:
                self._extend()
                self._audit()
                self._let_go()
        self._last = self._update(numbers, looks)
        return self._last

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
        """
        template = self._running().template
        parts: list[tuple[Part, str]] = [
            (kind, name)
            for kind, name in zip(KINDS, (camera, laser, plane), strict=True)
            if name is not None
        ]
        if not parts:
            raise DataError("reset: say what has moved: camera=, laser= or plane=")
        for kind, name in parts:
            known = getattr(template, f"{kind}s")
            if name not in known:
                raise DataError(f"reset: {kind} {name!r} is not among {', '.join(known)}")
        self._free(parts)
        self._extend()
        self._last = self._update(range(0), [])
        return self._last

    def dismiss(self) -> Update:
        """Close an alarm: nothing has moved. The spots held back are used as they are."""
        if self._alarm is not None:
            self._end_alarm("resolved", "the alarm was dismissed: its spots are used")
        self._last = self._update(range(0), [])
        return self._last

    # --- beginning ------------------------------------------------------------------------------

    def _collect(self) -> None:
        seen = len(self._store)
        planes = {path[2] for path in self._store.paths}
        need = max(spots_needed(len(planes)), _FIRST_SPOTS)
        words = f"at least {need} spots are needed, 30 or more are advisable: {seen} so far"
        if seen >= need:
            if seen < self._next_attempt:
                self._missing = (replace(self._missing[0], have=seen),)
                return
            self._next_attempt = int(np.ceil(_ATTEMPT_GROWTH * (seen + 1)))
            try:
                found = calibrate(self._store.observations(), options=self._options)
            except LasercalError as error:
                words, need = str(error), seen + 1
            else:
                lacking = int(np.ceil((_FIRST_DOF - found.fit.dof) / 2))
                if found.fit.converged and lacking <= 0:
                    self._begin(found)
                    return
                need = seen + max(lacking, 1)
                words = found.fit.status
                if found.fit.converged:
                    words = f"the {seen} spots fit, but {lacking} more are needed to judge how well"
        self._missing = (Missing("cell", "", seen, need, words),)

    def _continue_from(self, calibration: Calibration) -> None:
        observations, fit = calibration.inputs.observations, calibration.fit
        complete = len(observations) == fit.n_spots + fit.n_rejected
        waits = any((r or "").startswith("held back") for r in calibration.spots.rejected)
        self._set_noise(calibration)
        if complete and not waits and np.isfinite(fit.sigma0):
            self._store.append(observations, pixel_covariances(observations, self._sigma_px))
            self._begin(calibration)
            return
        belief = Belief.of(calibration)
        n = len(belief.information)
        scale = fit.sigma0 / self._unit
        prior = np.zeros((n + 1, n + 1))
        prior[:n, :n] = scale**2 * belief.information
        prior[n, n] = scale**2 * fit.dof
        self._older, self._used_before = fit.n_spots + fit.n_rejected, fit.n_spots
        self._store = SpotStore(dict(observations.image_size))
        rows = fit.dof + float(n - belief.held.sum())
        self._start_filter(belief.cell, calibration, prior=prior, rows=rows, scale=scale)
        self._note("started", f"from a calibration of {fit.n_spots} spots, by its covariance")

    def _begin(self, found: Calibration, words: str = "") -> None:
        """From a batch solution of all stored spots, or of those that are used so far."""
        self._set_noise(found)
        fit = found.fit
        if fit.n_spots + fit.n_rejected == len(self._store):
            rejected = [reason is not None for reason in found.spots.rejected]
            marks = np.where(rejected, LEFT_OUT, USED).astype(np.uint8)
            self._store.mark_each(self._store.first, marks)
        filter = self._start_filter(calibrated_parts(found), found, scale=fit.sigma0 / self._unit)
        filter.use(self._store.first, self._store.end)
        filter.relinearise()
        self._missing, self._next_audit = (), int(_AUDIT_GROWTH * len(self._store))
        self._note("started", words or f"with {fit.n_spots} spots, RMS {fit.rms_px:.3g} px")

    def _set_noise(self, found: Calibration) -> None:
        """Pixel sigma for spots without one; found along with the robot's noise, if not stated."""
        if self._finds_sigma:
            self._sigma_px = self._unit = found.fit.sigma0

    def _start_filter(
        self,
        cell: Cell,
        found: Calibration,
        *,
        prior: Array | None = None,
        rows: float = 0.0,
        scale: float = 1.0,
    ) -> Filter:
        aspects = tied_aspects(found)
        tied = tuple(aspects.get(name) for name in cell.cameras)
        held = np.diag(found.covariance) == 0.0
        self._initial, self._words = found.initial, found.observability.held
        # a covariance holds its priors already
        self._priors = {} if prior is not None else self._holds(cell).priors
        self._filter = Filter(
            self._store,
            cell,
            held,
            tied,
            prior=prior,
            prior_rows=rows,
            soft=soft_priors(cell, tied, held, self._priors),
            weighing=self._weighing(),
            scale=scale,
            robust=self._options.robust != "none",
        )
        self._detector = Detector.start(
            len(cell.cameras),
            len(cell.lasers),
            len(cell.planes),
            outliers=self._older - self._used_before + self._rejected(),
            good=found.fit.n_spots,
        )
        self._looked_at.clear()
        return self._filter

    def _weighing(self) -> Weighing:
        noise = HandNoise(self._options.hand_sigma_m, self._options.hand_sigma_rad)
        return Weighing(noise.variances, self._fade)

    def _holds(self, cell: Cell) -> Holds:
        """What the options hold of the parts that stored spots show, as the cell orders them."""
        seen = self._store.observations()
        holds = resolve_holds(seen, self._options, cell)
        ordered = Cell(
            {name: cell.cameras[name] for name in seen.cameras},
            {name: cell.lasers[name] for name in seen.lasers},
            {name: cell.planes[name] for name in seen.planes},
        )
        where = dict(zip(tangent_labels(ordered), holds.held.tolist(), strict=True))
        held = [where.get(label, False) for label in tangent_labels(cell)]
        return replace(holds, held=np.array(held, dtype=np.bool_))

    def _audit(self) -> None:
        """While there are few spots, see whether a fresh start from all of them ends better."""
        filter = self._running()
        count = len(self._store)
        if not self._next_audit <= count <= _AUDITED or self._older or self._store.first:
            return
        self._next_audit = int(_AUDIT_GROWTH * count)
        if self._open or self._pending or self._fade < 1.0:
            return
        used = np.flatnonzero(self._store.marks() == USED)
        # outliers stay out: looking for them anew would take seconds
        spots, plain = self._store.observations()[used], replace(self._options, robust="none")
        try:
            found = calibrate(spots, options=plain)
        except LasercalError:
            return
        fit, now = found.fit, filter.estimate
        if not fit.converged:
            return
        if self._finds_sigma:
            words = f"anew with {fit.n_spots} spots: their noise is {fit.sigma0:.3g} px"
        elif now.cost - fit.dof * fit.sigma0**2 > _TOLD_APART * now.sigma0**2:
            words = f"anew with {fit.n_spots} spots: a better solution was found"
        else:
            return
        self._begin(found, words)

    @property
    def _finds_sigma(self) -> bool:
        """Whether the pixel sigma has to be told apart from the robot's noise."""
        o = self._options
        return o.sigma_px is None and (o.hand_sigma_m > 0 or o.hand_sigma_rad > 0)

    def _rejected(self) -> int:
        return int((self._store.marks() == LEFT_OUT).sum())

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
        since = None if self._alarm is not None else self._look(filter, number, seen)
        if self._alarm is None and since is None:
            limit = rejection_length(filter.count + 1) if filter.robust else np.inf
            good = seen.chi2 <= limit * limit
            self._store.mark(number, number + 1, USED if good else LEFT_OUT)
            filter.use(number, number + 1)
            filter.settle()
            return seen
        filter.use(number, number + 1)
        if since is not None:
            self._open_alarm(filter, since)
        return seen

    def _look(self, filter: Filter, number: int, seen: Innovation) -> int | None:
        """Watch for a change; the number of the first spot that is affected, if there is one."""
        camera, laser, plane, _ = self._store.path_of(number)
        cell = filter.template
        width, height = self._store.image_size[camera]
        self._looked_at.append(number)
        verdict = self._detector.look(
            Look(
                seen.e,
                list(cell.cameras).index(camera),
                list(cell.lasers).index(laser),
                list(cell.planes).index(plane),
                seen.by_parts[:, :6],
                seen.by_parts[:, 6:10],
                seen.by_parts[:, 10:],
                width * height / seen.area,
                max(filter.dof, 1.0),
            )
        )
        if verdict.since is None:
            return None
        back = self._detector.number - verdict.since
        return self._looked_at[-min(back, len(self._looked_at))]

    def _let_go(self) -> None:
        """Fold the oldest spots into the prior where there are more than are to be kept."""
        if self._max_spots is None:
            return
        most = self._max_spots
        if len(self._store) >= most + max(1, int(_FOLDED_SHARE * most)):
            oldest = min(self._pending, default=self._store.end)
            self._running().fold(min(self._store.end - most, oldest))

    # --- alarms ---------------------------------------------------------------------------------

    def _open_alarm(self, filter: Filter, since: int) -> None:
        self._since = max(since, self._store.first)
        filter.take_out(self._since, filter.end, HELD_BACK)
        label, number = self._store.label(self._since), self._older + self._since
        self._alarm = Alarm(label, number, 0, (), "")

    def _examine(self) -> None:
        """Which cause explains the spots since the alarm best; act where that is sure."""
        filter, alarm = self._running(), self._alarm
        if alarm is None:
            return
        count = self._store.end - self._since
        if alarm.causes and (count > _DIAGNOSED or (count > _AT_EACH and count % 5)):
            self._alarm = replace(alarm, spots=count)
            return
        spots = self._store.observations(
            self._since, min(self._store.end, self._since + _DIAGNOSED)
        )
        estimate = filter.estimate
        known = self._known(spots, estimate.template)
        found = diagnose(
            estimate.belief(),
            spots[known],
            filter.scale**2 * pixel_covariances(spots, self._sigma_px)[known],
            outlier_rate=self._detector.outlier_rate,
            hand_noise=HandNoise(self._options.hand_sigma_m, self._options.hand_sigma_rad),
        )
        words = f"since spot {alarm.since}: {found.words}"
        self._alarm = replace(alarm, spots=count, causes=found.causes, words=words)
        if not alarm.causes:
            self._note("alarm", words)
        cause = found.causes[0]
        sure = cause.probability >= _SURE
        if cause.kind == "outliers" and count >= _LONG_ENOUGH:
            sure = cause.probability > 0.5
        if not sure or count < _FEWEST:
            return
        if cause.kind == "outliers":
            self._end_alarm("withdrawn", f"nothing has moved since spot {alarm.since}: outliers")
        elif self._automatic and cause.kind == "robot":
            self._end_alarm("resolved", f"{cause.words}; the sigmas adapt")
        elif self._automatic:
            self._free([(cause.kind, cause.name)], cause.words)  # type: ignore[list-item]

    def _known(self, spots: Observations, cell: Cell) -> Mask:
        """Spots all of whose parts are determined."""
        good = np.isin(spots.camera, list(cell.cameras)) & np.isin(spots.laser, list(cell.lasers))
        good &= np.isin(spots.plane, list(cell.planes))
        for kind, name in self._open:
            good &= getattr(spots, kind) != name
        return np.asarray(good)

    def _end_alarm(self, kind: EventKind, words: str) -> None:
        """Take the spots that were held back as they are."""
        self._alarm = None
        waiting = set(self._pending)
        self._mark_used(n for n in range(self._since, self._store.end) if n not in waiting)
        self._detector.reset()
        self._note(kind, words)

    def _mark_used(self, numbers: Iterable[int]) -> None:
        """Use spots that were held back, as far as they fit; everything is relinearised."""
        for number in numbers:
            self._store.mark(number, number + 1, USED)
        self._running().relinearise()

    # --- parts that move, and new ones ----------------------------------------------------------

    def _free(self, parts: Sequence[tuple[Part, str]], why: str = "") -> None:
        """Turn older spots into prior knowledge, in which these parts are then forgotten."""
        filter = self._running()
        onset = self._store.end if self._alarm is None else self._since
        filter.fold(onset)
        for kind, name in parts:
            at = part_offset(filter.template, kind, name)
            filter.forget_part(slice(at, at + _SIZES[kind]))
            self._open.add((kind, name))
        self._pending = sorted({*self._pending, *range(onset, self._store.end)})
        self._alarm = None
        self._detector.reset()
        self._use_ready()
        named = " and ".join(f"{kind} {name!r}" for kind, name in parts)
        self._note("reset", f"{named} freed{': ' + why if why else ''}")

    def _extend(self) -> None:
        """Find parts that are new or freed, as far as the spots that wait determine them."""
        while self._pending or self._open:
            cell = self._running().estimate.cell
            waiting = self._store.chosen(self._pending) if self._pending else None
            unknown = self._unknown_parts(waiting, cell)
            self._missing = ()
            found = False
            for kind, name in unknown:
                known = without_parts(cell, [p for p in unknown if p != (kind, name)])
                if waiting is None:
                    words = f"{kind} {name!r} was freed and has no spots yet"
                    self._missing += (Missing(kind, name, 0, _SIZES[kind], words),)
                    continue
                missing = missing_for(kind, name, waiting, known)
                self._missing += missing
                if not missing:
                    self._place(kind, name, located(kind, name, waiting, known))
                    found = True
                    break
            if not found:
                return
        self._missing = ()

    def _unknown_parts(self, waiting: Observations | None, cell: Cell) -> list[tuple[Part, str]]:
        """Parts that are freed, or that spots wait for; those named first that are freed."""
        unknown = sorted(self._open)
        for kind in KINDS if waiting is not None else ():
            for name in getattr(waiting, f"{kind}s"):
                if name not in getattr(cell, f"{kind}s"):
                    unknown.append((kind, name))
        return unknown

    def _place(self, kind: Part, name: str, part: Camera | Beam | Plane) -> None:
        """Take in a part that was located, and the spots that waited for it alone."""
        old = self._running()
        is_new = name not in getattr(old.template, f"{kind}s")
        if isinstance(part, Camera) and not is_new:
            # the chart's intrinsics stay where the prior's coordinates begin
            part = replace(old.template.cameras[name], T_base_camera=part.T_base_camera)
        cell = with_part(old.template, kind, name, part)
        if is_new:
            self._initial = with_part(self._initial, kind, name, part)
        self._open.discard((kind, name))
        self._filter = self._relaid(old, cell, kind, name)
        self._filter.folded, self._filter.fallbacks = old.folded, old.fallbacks
        counts = len(cell.cameras), len(cell.lasers), len(cell.planes)
        self._detector.cover(*counts)
        self._use_ready()
        verb = "found" if is_new else "found again"
        self._note("extended" if is_new else "recovered", f"{kind} {name!r} {verb}")

    def _use_ready(self) -> None:
        """Use the spots that wait for nothing any more."""
        if self._pending:
            cell = self._running().template
            known = self._known(self._store.chosen(self._pending), cell)
            ready = [n for n, good in zip(self._pending, known, strict=True) if good]
            self._pending = sorted(set(self._pending) - set(ready))
            self._mark_used(ready)

    def _relaid(self, old: Filter, cell: Cell, kind: Part, name: str) -> Filter:
        """The same knowledge in the chart of a cell with a part more, or elsewhere."""
        labels = tangent_labels(cell)
        where = {label: i for i, label in enumerate(labels)}
        columns = np.array([where[label] for label in tangent_labels(old.template)])
        n = len(labels)
        everything = np.append(columns, n)
        prior = np.zeros((n + 1, n + 1))
        prior[np.ix_(everything, everything)] = old.prior
        start = np.zeros(n)
        start[columns] = old.z
        at = part_offset(cell, kind, name)
        start[at : at + _SIZES[kind]] = 0.0
        held, still_open = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        held[columns] = old.held
        still_open[columns] = old.open
        still_open[at : at + _SIZES[kind]] = False
        holds = self._holds(cell)
        if not old.prior_rows:
            lens = np.array([label.rpartition(".")[2] in DISTORTION_NAMES for label in labels])
            held = holds.held | (held & lens)
            self._priors, self._words = holds.priors, holds.words
        elif kind == "camera" and name not in old.template.cameras:
            held[at : at + 15] = holds.held[at : at + 15]
        aspects = {**dict(zip(old.template.cameras, old.chart.aspects, strict=True))}
        tied = tuple(aspects.get(c, holds.aspect.get(c)) for c in cell.cameras)
        return Filter(
            self._store,
            cell,
            held,
            tied,
            prior=prior,
            prior_rows=old.prior_rows,
            soft=soft_priors(cell, tied, held, self._priors),
            weighing=old.weighing,
            start=start,
            open=still_open,
            end=old.end,
            scale=old.scale,
            robust=old.robust,
        )

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
        accepted, rejected, held_back = [], [], []
        for number, look in zip(numbers, seen, strict=False):
            label = self._store.label(number)
            mark = self._store.mark_of(number)
            if mark == USED:
                accepted.append(label)
            elif mark == HELD_BACK:
                held_back.append(label)
            else:
                rejected.append(Rejection(label, self._reason(look)))
        events = tuple(self._events[self._reported :])
        self._reported = len(self._events)
        make = self._answer(estimate)
        update = Update(
            phase=self.phase,
            accepted=tuple(accepted),
            rejected=tuple(rejected),
            held_back=tuple(held_back),
            innovation=innovations_of([self._store.label(n) for n in numbers], seen),
            alarm=self._alarm,
            missing=self._missing,
            events=events,
            n_spots=self.n_spots,
            n_used=0 if estimate is None else self._used(estimate),
            sigma0=float("nan") if estimate is None else self._unit * estimate.sigma0,
            rms_px=float("nan") if estimate is None else estimate.rms_px,
            _cell=lambda: None if estimate is None else estimate.cell,
            _parameters=lambda: () if estimate is None else parameters_of(estimate, initial),
            _calibration=make,
        )
        initial = self._initial
        if estimate is not None and (events or self.n_spots >= self._next_row):
            grown = int(np.ceil(_HISTORY_GROWTH * self.n_spots))
            self._next_row = self.n_spots + 1 if self.n_spots < _EVERY_SPOT else grown
            self._history.append(update)
        return update

    def _used(self, estimate: Estimate) -> int:
        return round(estimate.weight + self._running().folded) + self._used_before

    def _reason(self, seen: Innovation | None) -> str:
        limit = self._running().limit / self._running().scale
        if seen is None or not np.isfinite(seen.chi2):
            return "no spot can be there"
        return f"{np.sqrt(seen.chi2):.1f} sigma from where it was expected, limit {limit:.1f}"

    def _answer(self, estimate: Estimate | None) -> Callable[[], Calibration | None]:
        """The whole result as it stands now, to be made when somebody asks."""
        if estimate is None or self._filter is None:
            return lambda: None
        store, first, end = self._store, self._store.first, self._store.end
        waiting = list(self._pending)
        troubles = [m.words for m in self._missing]
        if self._alarm is not None:
            waiting += range(self._since, end)
            troubles.append(self._alarm.words)
        account = Account(
            initial=self._initial,
            options=self._options,
            sigma_px=self._sigma_px,
            limit=self._filter.limit,
            waiting=tuple(waiting),
            older=self._older + first,
            words=self._words,
            troubles=tuple(troubles),
            notes=(),
        )
        unit = self._unit

        def make() -> Calibration:
            begin = max(first, store.first)
            return calibration_of(estimate, store.observations(begin, end), begin, account, unit)

        return make
