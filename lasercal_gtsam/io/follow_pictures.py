"""Pictures that arrive one by one: each is looked at when it is whole, and not before."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lasercal_gtsam.errors import DataError, DetectionError
from lasercal_gtsam.io.capture_head import CaptureHead, ImagesHead
from lasercal_gtsam.io.growing import Clock
from lasercal_gtsam.io.pictures import PLACEHOLDERS, Picture, expand_pattern, read_picture
from lasercal_gtsam.io.spot_account import FoundSpot
from lasercal_gtsam.io.stand_in import MAX_PICTURES, MIN_ROWS, WITHOUT, Scene, evenly, median_of

Detector = Callable[[Picture, Picture | None], FoundSpot]
Names = Mapping[str, str]

# A picture that has not changed for so long is whole, unless it cannot be read.
_WHOLE_S = 0.3
# One that has not changed for so long is not being written any more, whatever is wrong with it; and
# a laser-off picture that has not come so long after the laser-on one does not come.
PATIENCE_S = 5.0


@dataclass(frozen=True)
class Wait:
    """Not yet: why, and whether the next look may already tell more."""

    why: str
    soon: bool = False


@dataclass(frozen=True)
class Fault:
    """The picture is of no use as it is; looked at again when the file changes.

    ``seen``: it could be read, and what is in it is why.
    """

    why: str
    seen: bool = False


@dataclass
class _File:
    """A file as it was when last looked at."""

    status: tuple[int, ...] = ()
    since: float = 0.0  # time from which on it has been like this
    fault: str = ""
    seen: bool = False  # the fault is in what the picture shows


@dataclass
class _Scene:
    """What stands in for the laser-off pictures of a scene that has none."""

    recent: dict[str, Path] = field(default_factory=dict)
    frame: Picture | None = None
    why: str | None = None
    made: bool = False
    since: int = 0  # pictures since it was made

    def add(self, name: str, path: Path) -> None:
        if name in self.recent:
            return
        self.recent[name] = path
        self.since += 1
        if len(self.recent) > MAX_PICTURES:
            del self.recent[next(iter(self.recent))]

    @property
    def due(self) -> bool:
        return not self.made or self.since >= len(self.recent) // 2


class PictureDesk:
    """Looks at the pictures of a capture's rows as they come.

    A row's laser-off picture is its own, or the background, as in `find_pictures`; where
    ``capture.yaml`` names neither, the median of up to 15 recent laser-on pictures of the same
    camera and plane stands in for it, and rows wait until there are five.

    Parameters
    ----------
    head, folder : of the capture
    place : what messages call ``capture.yaml``
    clock : seconds, for how long files have not changed
    detector : ``(on, off or None) -> detection``; None: as in `Capture.detections`

    Raises
    ------
    DataError
        A pattern that does not say which row a picture belongs to.
    """

    def __init__(
        self,
        head: CaptureHead,
        folder: Path,
        place: str,
        detector: Detector | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        assert head.images is not None
        self._images = head.images
        self._folder = folder
        self._sizes = {camera.name: (camera.width, camera.height) for camera in head.camera}
        self._detector, self._clock = detector, clock
        self._files: dict[Path, _File] = {}
        self._alone = head.images.off is None and head.images.background is None
        self._by_id = "{id}" in head.images.on
        self._scenes: dict[Scene, _Scene] = {}
        self._without_off: dict[str, float] = {}
        self._owner: dict[Path, str] = {}
        self._notes: list[str] = []
        _check_patterns(head.images, folder, place)

    def look(self, names: Names) -> FoundSpot | Wait | Fault:
        """Look at the pictures of a row, if they are there.

        ``names`` are what the placeholders stand for: ``id``, ``plane``, ``camera``, ``laser``.
        """
        on = self._path(self._images.on, names)
        owner = self._owned(on, names)
        if owner != names["id"]:
            return Fault(f"the picture {on} is already that of id {owner}")
        wait = self._not_whole(on, "picture")
        off = None if self._alone else self._off(names, there=wait is None)
        if wait is None and self._alone:
            wait = self._enough(names, on)
        if wait is not None:
            return wait
        if isinstance(off, Wait):
            return off
        paths = [on] if off is None else [on, off]
        faulty = [path for path in paths if self._files[path].fault]
        if faulty:
            return self._faulty(faulty[0])
        pictures: list[Picture] = []
        for path in paths:
            try:
                pictures.append(read_picture(path, self._sizes[names["camera"]], _id(names)))
            except DataError as error:
                self._files[path].fault = str(error).removeprefix(f"{_id(names)}: ")
                return self._faulty(path)
        frame = self._stand_in(names, pictures[0]) if self._alone else pictures[1]
        found = self._detect(pictures[0], frame, on)
        if isinstance(found, Fault):
            self._files[on].fault, self._files[on].seen = found.why, True
        return found

    def remember(self, names: Names) -> None:
        """A row that was looked at in an earlier run; its picture may be part of a stand-in."""
        on = self._path(self._images.on, names)
        self._owned(on, names)
        if self._alone and on.is_file():
            self._scene(names).add(names["id"], on)

    def take_notes(self) -> list[str]:
        """How scenes without laser-off pictures are dealt with: new sentences, given once."""
        notes, self._notes = self._notes, []
        return notes

    def done_with(self, names: Names) -> None:
        """Forget the files of a row that gave its spot."""
        self._without_off.pop(names["id"], None)
        for pattern in (self._images.on, self._images.off):
            if pattern is not None:
                self._files.pop(self._path(pattern, names), None)

    def _path(self, pattern: str, names: Names) -> Path:
        if "{" not in pattern:
            return self._folder / pattern
        return expand_pattern(pattern, self._folder, [names])[0]

    def _not_whole(self, path: Path, kind: str) -> Wait | None:
        """Why a file is not to be read yet, if so; looks at it."""
        try:
            status = path.stat()
        except OSError:
            self._files.pop(path, None)
            return Wait(f"the {kind} {path} is not there yet")
        key = (status.st_ino, status.st_size, status.st_mtime_ns)
        known = self._files.get(path)
        if known is None or known.status != key:
            # a file from before this run need not be waited for
            age = max(0.0, time.time() - status.st_mtime) if known is None else 0.0
            self._files[path] = known = _File(key, self._clock() - age)
        if self._age(path) >= _WHOLE_S:
            return None
        return Wait(f"the {kind} {path} is still being written", True)

    def _age(self, path: Path) -> float:
        return self._clock() - self._files[path].since

    def _off(self, names: Names, there: bool) -> Path | Wait:
        """Laser-off picture of a row; ``there``: its laser-on picture is."""
        own, shared = self._images.off, self._images.background
        wait = None
        if own is not None:
            path = self._path(own, names)
            wait = self._not_whole(path, "laser-off picture")
            if wait is None:
                return path
            if shared is None or path.exists() or not there:
                return wait
            since = self._without_off.setdefault(names["id"], self._clock())
            if self._clock() - since < PATIENCE_S:
                return wait
        assert shared is not None
        background = self._path(shared, names)
        return self._not_whole(background, "laser-off picture") or background

    def _faulty(self, path: Path) -> Wait | Fault:
        """A picture that cannot be read may be one that is written slowly."""
        file = self._files[path]
        final = file.seen or self._age(path) >= PATIENCE_S
        return Fault(file.fault, file.seen) if final else Wait(file.fault)

    def _enough(self, names: Names, on: Path) -> Wait | None:
        """Whether there are pictures enough to make a laser-off picture of; counts this one."""
        scene = self._scene(names)
        scene.add(names["id"], on)
        if len(scene.recent) >= MIN_ROWS:
            return None
        return Wait(
            f"there is no laser-off picture; {MIN_ROWS} laser-on pictures of {_about(names)} can "
            "make one, and there are fewer yet"
        )

    def _stand_in(self, names: Names, on: Picture) -> Picture | None:
        scene = self._scene(names)
        if scene.due:
            self._make(scene, names)
        frame = scene.frame
        fits = frame is not None and (frame.shape, frame.dtype) == (on.shape, on.dtype)
        return frame if fits else None

    def _make(self, scene: _Scene, names: Names) -> None:
        pictures, size = [], self._sizes[names["camera"]]
        recent = list(scene.recent.items())
        for k in evenly([*range(len(recent))]):
            name, path = recent[k]
            try:
                pictures.append(read_picture(path, size, f"id {name}"))
            except DataError:  # cleared away, or not good: its own row says so
                del scene.recent[name]
        before = scene.why if scene.made else ""
        scene.frame, scene.why = median_of(pictures, self._images.saturation)
        scene.made, scene.since = True, 0
        if scene.why == before:
            return
        said = f"{_about(names)}: there are no laser-off pictures; "
        if scene.why is None:
            self._notes.append(
                f"{said}the median of {len(pictures)} laser-on pictures stands in for them"
            )
        else:
            self._notes.append(
                f"{said}{WITHOUT}, where every bright thing looks like a spot, because the median "
                f"of {len(pictures)} laser-on pictures cannot stand in ({scene.why})"
            )

    def _scene(self, names: Names) -> _Scene:
        return self._scenes.setdefault((names["camera"], names["plane"]), _Scene())

    def _owned(self, on: Path, names: Names) -> str:
        """Id of the row that a picture belongs to."""
        return names["id"] if self._by_id else self._owner.setdefault(on, names["id"])

    def _detect(self, on: Picture, off: Picture | None, path: Path) -> FoundSpot | Fault:
        if self._detector is None:
            from lasercal_gtsam.detect.options import DetectionOptions
            from lasercal_gtsam.detect.pipeline import detect_spot

            options = DetectionOptions(saturation_level=self._images.saturation)
            self._detector = lambda on, off: detect_spot(on, off, options)
        try:
            found = self._detector(on, off)
        except (DataError, DetectionError) as error:
            return Fault(f"{path}: {error}", True)
        if not found.usable:
            return Fault(": ".join(filter(None, [found.verdict, found.reason])), True)
        return found


def _check_patterns(images: ImagesHead, folder: Path, place: str) -> None:
    problems = []
    anyone = dict.fromkeys(PLACEHOLDERS, "")
    for key, pattern in (("on", images.on), ("off", images.off), ("background", images.background)):
        if pattern is None:
            continue
        if "{" in pattern:
            try:
                expand_pattern(pattern, folder, [anyone])
            except DataError as error:
                problems.append(f"{place}: images.{key}: {error}")
        elif key != "background":
            problems.append(
                f"{place}: images.{key}: {pattern!r} gives pictures to rows by their order, which "
                "is not certain while both grow; use a placeholder such as {id}"
            )
    if problems:
        raise DataError(*problems)


def _about(names: Names) -> str:
    return f"camera {names['camera']!r}, plane {names['plane']!r}"


def _id(names: Names) -> str:
    return f"id {names['id']}"
