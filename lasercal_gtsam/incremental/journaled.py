"""A running calibration that survives its process: every call is on the disk before it is made."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from lasercal_gtsam.errors import DataError, LasercalError
from lasercal_gtsam.incremental.calibrator import IncrementalCalibrator
from lasercal_gtsam.incremental.parts import KINDS
from lasercal_gtsam.io.calibration_file import load_calibration
from lasercal_gtsam.io.files import read_bytes, sha256_of, write_bytes
from lasercal_gtsam.io.journal import Journal, JournalReader, observations_from, spots_payload
from lasercal_gtsam.io.known_spots import KnownSpots
from lasercal_gtsam.io.plain import plain
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.incremental.update import Update

Progress = Callable[[int, int], None]

THE_START, THIS_JOURNAL = "the start", "this journal"  # where spots are, for messages
SPOT, RESET, DISMISS = "spot", "reset", "dismiss"


class JournaledCalibrator:
    """An `IncrementalCalibrator` with a journal: opened again, it is where it was.

    Spots go to the journal first and are then taken one by one, so that the estimate does not
    depend on how they were grouped. A start is copied beside the journal, which then needs nothing
    else.

    Parameters
    ----------
    path : the journal; made if it is not there, else gone through first
    start : ``calibration.json`` to begin with; may be left out when the journal is there
    options : as for `calibrate`, for a beginning without a start (a start has its own)
    settings : ``automatic``, ``max_spots``, ``half_life`` of `IncrementalCalibrator`
    progress : called with (records gone through, records there are)

    Attributes
    ----------
    calibrator : the running calibration; to be read only
    known : all spots of the start and of the journal
    start : the calibration it began with, or None
    sources : the name of its copy, and its SHA-256
    image_size : of all cameras so far: name to (width, height), pixels
    replayed : how many records the journal had
    repaired : what was cut off from the end of the journal, as a sentence, or None

    Raises
    ------
    DataError
        The journal was begun another way, is in use, or damaged elsewhere than at its end; or the
        start cannot be read.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        start: str | Path | None = None,
        options: CalibrationOptions | None = None,
        settings: Mapping[str, Any] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.path = Path(path)
        wanted = _About(start, options, dict(settings or {}))
        self._journal = Journal.open(self.path, wanted.header)
        if not self._journal.count and wanted.replaces(self._journal.about):
            self._journal.close()
            self.path.unlink()  # nothing has come since it was begun another way
            self._journal = Journal.open(self.path, wanted.header)
        try:
            self._open(wanted, progress)
        except BaseException:
            self._journal.close()
            raise

    def _open(self, wanted: _About, progress: Progress | None) -> None:
        copy = self.path.with_name(f"{self.path.name}.start")
        about = self._journal.about
        wanted.check(about, self.path)
        self.start = self._load_start(about.get("start"), wanted.start, copy)
        self.sources = {} if self.start is None else {copy.name: about["start"]}
        options = None if self.start is not None else wanted.options
        self.calibrator = IncrementalCalibrator(self.start, options, **wanted.settings)
        self.known = KnownSpots()
        self.image_size: dict[str, tuple[int, int]] = {}
        self._lasers: dict[str, None] = {}
        if self.start is not None:
            self._note(self.start.inputs.observations, THE_START)
        self.repaired = self._journal.repaired
        self.replayed = 0
        for record in JournalReader(self.path):
            self._replay(record.kind, record.payload, record.seq)
            self.replayed += 1
            if progress is not None:
                progress(self.replayed, self._journal.count)

    def _load_start(self, digest: str | None, given: Path | None, copy: Path) -> Calibration | None:
        if digest is None:
            return None
        if not copy.exists() or sha256_of(copy) != digest:
            if given is None or sha256_of(given) != digest:
                raise DataError(
                    f"{self.path}: begins with a calibration whose copy {copy.name} is "
                    f"{'changed' if copy.exists() else 'missing'}; put it back, or name the same "
                    "calibration as at the beginning"
                )
            write_bytes(copy, read_bytes(given))
        return load_calibration(copy)

    def _replay(self, kind: str, payload: Mapping[str, Any], seq: int) -> None:
        if kind == SPOT:
            spot = observations_from(payload)
            self._note(spot, THIS_JOURNAL)
            try:
                self.calibrator.add(spot)
            except LasercalError:
                return  # said when it came
        elif kind in (RESET, DISMISS):
            if not all(k in KINDS and isinstance(name, str) for k, name in payload.items()):
                raise DataError(
                    f"{self.path}: record {seq} is a {kind!r} with {dict(payload)!r:.60}; expected "
                    f"the names of parts ({', '.join(KINDS)})"
                )
            try:
                self._do(kind, payload)
            except LasercalError:
                return  # likewise
        else:
            raise DataError(
                f"{self.path}: record {seq} is a {kind!r}, which this program does not know; use a "
                "newer lasercal-gtsam"
            )

    def _note(self, spots: Observations, where: str) -> None:
        self.known.add(spots, where)
        self.image_size |= spots.image_size
        self._lasers |= dict.fromkeys(spots.lasers)

    @property
    def lasers(self) -> tuple[str, ...]:
        """Names of all lasers so far."""
        return tuple(self._lasers)

    def check_sizes(self, image_size: Mapping[str, tuple[int, int]]) -> None:
        """Raise `DataError` where a camera's pictures had another size so far."""
        for name, size in image_size.items():
            before = self.image_size.get(name, size)
            if before != size:
                raise DataError(
                    f"camera {name!r}: image size {size[0]} x {size[1]}, but it was {before[0]} x "
                    f"{before[1]} so far; a camera that was set up differently needs another name"
                )

    def add(self, spots: Sequence[Observations]) -> Iterator[Update | LasercalError]:
        """Take single spots: when this returns, all are in the journal, and none is lost.

        Iterating takes them; an error in place of an answer belongs to that spot alone.

        Raises
        ------
        DataError
            They could not be written, and do not count; or a camera's image size is another.
        """
        for spot in spots:
            self.check_sizes(spot.image_size)
        self._journal.append_many((SPOT, spots_payload(spot)) for spot in spots)
        for spot in spots:
            self._note(spot, THIS_JOURNAL)
        return self._take(spots)

    def _take(self, spots: Iterable[Observations]) -> Iterator[Update | LasercalError]:
        for spot in spots:
            try:
                yield self.calibrator.add(spot)
            except LasercalError as error:
                yield error

    def reset(self, part: str, name: str) -> Update:
        """As `IncrementalCalibrator.reset`; ``part`` is ``camera``, ``laser`` or ``plane``."""
        payload = {part: name}
        self._journal.append(RESET, payload)
        return self._do(RESET, payload)

    def dismiss(self) -> Update:
        """As `IncrementalCalibrator.dismiss`."""
        self._journal.append(DISMISS, {})
        return self._do(DISMISS, {})

    def _do(self, kind: str, payload: Mapping[str, Any]) -> Update:
        return self.calibrator.reset(**payload) if kind == RESET else self.calibrator.dismiss()

    def close(self) -> None:
        """Let the next one in."""
        self._journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _About:
    """What a journal must have been begun with."""

    def __init__(
        self,
        start: str | Path | None,
        options: CalibrationOptions | None,
        settings: dict[str, Any],
    ) -> None:
        self.start = None if start is None else Path(start)
        self.options = options or CalibrationOptions()
        self.settings = settings
        self.header = {
            "start": None if self.start is None else sha256_of(self.start),
            "options": plain(self.options) if self.start is None else None,
            **settings,
        }

    def replaces(self, about: Mapping[str, Any]) -> bool:
        """Whether a journal without a record, begun another way, may be begun anew.

        Not one whose start is not named again: that would be lost.
        """
        begun = about.get("start")
        return dict(about) != self.header and (self.start is not None or begun is None)

    def check(self, about: Mapping[str, Any], path: Path) -> None:
        """Raise `DataError` where a journal was begun another way, with every difference."""
        problems = [
            f"{name} was {about.get(name)!r}, now it is {value!r}"
            for name, value in self.settings.items()
            if about.get(name) != value
        ]
        begun = about.get("start")
        if self.start is not None and begun != self.header["start"]:
            what = "without a calibration" if begun is None else "with another calibration"
            problems.append(f"it was begun {what} than {self.start}")
        elif begun is None:
            before = about.get("options")
            before = before if isinstance(before, Mapping) else {}
            problems += _differences(before, plain(self.options))
        if problems:
            raise DataError(
                *(f"{path}: this journal was begun another way: {text}" for text in problems),
                f"{path}: go on as it was begun, or begin a new journal under another name",
            )


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"option {name} was {before.get(name)!r}, now it is {now.get(name)!r}"
        for name in dict.fromkeys([*before, *now])
        if before.get(name) != now.get(name)
    ]
