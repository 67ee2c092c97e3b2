"""Choose from a recording what becomes a capture: one picture, or an on/off pair, for each stop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.io.pictures import Picture
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.recordings.laser import (
    OFF,
    ON,
    LaserAt,
    States,
    most_central,
    spot_appears,
    states_of,
)
from lasercal_gtsam.recordings.motion import Motion
from lasercal_gtsam.recordings.planes import PlaneNames
from lasercal_gtsam.recordings.sources import PictureSource
from lasercal_gtsam.recordings.stamps import NS_PER_S, Stamps, duration_text, seconds_text
from lasercal_gtsam.recordings.stops import (
    StillLimits,
    Stop,
    find_stops,
    split_stops,
    stops_of_pictures,
)

MOST_PICTURES = 9
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Shot(FrozenData):
    """One row of the capture to be.

    Attributes
    ----------
    id, camera, plane : as in the capture
    stop : number of the stop, from 1
    T_base_hand : (4, 4), metres, at the stamp of the laser-on picture
    on, off : indices of the pictures in the camera's source; ``off`` is None where there is none
    stamp, off_stamp : their stamps, nanoseconds
    off_own : the laser-off picture was taken in the same stop
    n_pictures : how many pictures of the camera the stop has
    """

    id: str
    camera: str
    plane: str
    stop: int
    T_base_hand: Array
    on: int
    off: int | None
    stamp: int
    off_stamp: int | None
    off_own: bool
    n_pictures: int

    def __post_init__(self) -> None:
        set_array(self, "T_base_hand", self.T_base_hand, (4, 4))


@dataclass(frozen=True)
class Plan:
    """What becomes a capture.

    Attributes
    ----------
    shots : rows, in the order of time
    stops : all stops that were found
    origin : the stamp from which times in messages count, nanoseconds
    left_out : a sentence for each stop that gives no row
    notes : what the user should know
    """

    shots: tuple[Shot, ...]
    stops: tuple[Stop, ...]
    origin: int
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def origin_of(motion: Motion, sources: Iterable[PictureSource]) -> int:
    """The earliest stamp of the hand's poses and of the pictures: times in words count from it."""
    return min([motion.span[0], *(int(source.stamps[0]) for source in sources)])


def plan_capture(
    motion: Motion,
    sources: Sequence[PictureSource],
    planes: PlaneNames,
    *,
    laser: LaserAt | Literal["see", "on"] = "see",
    limits: StillLimits | None = None,
    every_picture: bool = False,
    progress: Progress | None = None,
) -> Plan:
    """Choose the pictures of every stop, without writing anything.

    Of each stop and camera the laser-on picture is taken that is farthest in time from motion and
    from switching of the laser, and a laser-off picture in the same way. A stop without one gets
    that of the nearest stop (in time) of its plane and camera. Only the pictures of one stop are in
    memory, at most 9 of them, evenly spread.

    Parameters
    ----------
    motion : the hand's poses
    sources : the cameras' pictures
    planes : which plane a picture shows; a stop for which none is said is left out
    laser : ``see``: told from the pictures of a stop; ``on``: on in every picture; or its state by
        stamp
    limits : when the hand stands still
    every_picture : the hand stood still in every picture: do not look for stops
    progress : called with (stops looked at, stops to look at)

    Raises
    ------
    DataError
        Pictures and poses do not overlap in time, the hand never stands still, a picture cannot
        be read, or nothing is left.
    """
    limits = StillLimits() if limits is None else limits
    for source in sources:
        _check_overlap(motion, source)
    origin = origin_of(motion, sources)
    if every_picture:
        stamps = np.unique(np.concatenate([source.stamps for source in sources]))
        stops = stops_of_pictures(motion, stamps, limits)
        unseen = len(stamps) - sum(
            int(((stamps >= stop.first) & (stamps <= stop.last)).sum()) for stop in stops
        )
    else:
        stops, unseen = find_stops(motion, limits), 0
    chooser = _Chooser(motion, planes, laser, limits, origin)
    for number, stop in enumerate(stops, start=1):
        for source in sources:
            chooser.look_at(number, stop, source)
        if progress is not None:
            progress(number, len(stops))
    shots = chooser.shots()
    notes = [*motion.notes, *chooser.notes]
    if unseen:
        notes.append(
            f"{unseen} pictures are left out: the hand's pose is not known at their stamps "
            f"(no pose there, or a gap of more than {duration_text(limits.max_gap_ns)})"
        )
    if not every_picture and (split := split_stops(motion, stops, limits)):
        notes.append(
            f"{split} stops begin at the very pose of the stop before them: the hand shakes, or "
            "the poses are as noisy as the limits; wider limits (--still-mm, --still-deg) join them"
        )
    if not shots:
        raise DataError(
            f"none of the {len(stops)} stops gives a row", *chooser.left_out[:20], *notes
        )
    return Plan(
        _with_ids(shots, len(sources)), stops, origin, tuple(chooser.left_out), tuple(notes)
    )


@dataclass
class _Pending:
    """A laser-on picture without a laser-off picture of its own stop."""

    shot: Shot
    source: PictureSource
    where: str
    sure: bool


class _Chooser:
    """Goes through the stops and keeps indices, not pictures."""

    def __init__(
        self,
        motion: Motion,
        planes: PlaneNames,
        laser: LaserAt | Literal["see", "on"],
        limits: StillLimits,
        origin: int,
    ) -> None:
        self._motion, self._planes, self._laser = motion, planes, laser
        self._limits, self._origin = limits, origin
        self._done: list[Shot] = []
        self._pending: list[_Pending] = []
        self._offs: dict[tuple[str, str], list[tuple[int, int]]] = {}
        self._without_picture: dict[str, list[str]] = {}
        self.left_out: list[str] = []
        self.notes: list[str] = []

    def look_at(self, number: int, stop: Stop, source: PictureSource) -> None:
        """Choose from one camera's pictures of one stop."""
        lowest, highest = np.searchsorted(source.stamps, [stop.first, stop.last + 1])
        members = np.arange(lowest, highest)
        where = f"stop {number} ({self._times(stop)})"
        if not len(members):
            missing = self._without_picture.setdefault(source.camera, [])
            missing.append(f"{number} ({self._times(stop)})")
            return
        members, state, uniform = self._states(members, source)
        if isinstance(state, str):
            self.left_out.append(f"{where}: {state}")
            return
        stamps = source.stamps[members]
        on = most_central(stamps, np.asarray(state == ON), stop.first, stop.last)
        off = most_central(stamps, np.asarray(state == OFF), stop.first, stop.last)
        chosen = on if on is not None else off
        if chosen is None:
            self.left_out.append(
                f"{where}: whether the laser is on cannot be told in its {highest - lowest} "
                "pictures"
            )
            return
        plane = self._planes(int(stamps[chosen]))
        if plane is None:
            self.left_out.append(f"{where}: no plane is said for it")
            return
        if off is not None:
            kept = self._offs.setdefault((source.camera, plane), [])
            kept.append((int(stamps[off]), int(members[off])))
        if on is None:
            self.left_out.append(f"{where}: the laser is off in all its pictures")
            return
        T, known = self._motion.at(stamps[[on]], self._limits.max_gap_ns)
        if not known[0]:
            self.left_out.append(f"{where}: the hand's pose is not known at the picture's stamp")
            return
        shot = Shot(
            id="",
            camera=source.camera,
            plane=plane,
            stop=number,
            T_base_hand=T[0],
            on=int(members[on]),
            off=None if off is None else int(members[off]),
            stamp=int(stamps[on]),
            off_stamp=None if off is None else int(stamps[off]),
            off_own=off is not None,
            n_pictures=int(highest - lowest),
        )
        if off is not None:
            self._done.append(shot)
        else:
            self._pending.append(_Pending(shot, source, where, sure=not uniform))

    def shots(self) -> list[Shot]:
        """All rows, after laser-off pictures were found for those that had none."""
        borrowed = []
        for pending in self._pending:
            shot = self._with_off(pending)
            if shot is not None:
                self._done.append(shot)
                borrowed += [str(shot.stop)] if shot.off is not None else []
        if borrowed:
            self.notes.append(
                f"{len(borrowed)} stops have no laser-off picture of their own (stop "
                f"{some(borrowed)}); that of the nearest stop of the same plane is used"
            )
        if self._pending and not self._offs:
            self.notes.append(
                "no picture without a spot was found: the laser is taken to be on in all of them"
                if self._laser == "see"
                else "there are no laser-off pictures"
            )
        self.notes += [
            f"{len(stops)} stops have no picture of {camera}: {some(stops)}"
            for camera, stops in self._without_picture.items()
        ]
        return sorted(self._done, key=lambda shot: (shot.stop, shot.camera))

    def _states(self, members: Stamps, source: PictureSource) -> tuple[Stamps, States | str, bool]:
        """Pictures to choose from, their states (or what is wrong), and whether all look alike."""
        if callable(self._laser):
            states = [self._laser(int(stamp)) for stamp in source.stamps[members]]
            return members, np.array(states, dtype=np.int8), False
        if self._laser == "on":
            return members, np.full(len(members), ON, dtype=np.int8), False
        if len(members) > MOST_PICTURES:
            members = members[np.rint(np.linspace(0, len(members) - 1, MOST_PICTURES)).astype(int)]
        read = dict(source.read(members.tolist()))
        sizes = {picture.shape for picture in read.values()}
        if len(sizes) > 1:
            return members, f"its pictures differ in size: {sorted(map(str, sizes))}", False
        seen = states_of([read[k] for k in members.tolist()])
        return members, seen.state, seen.uniform

    def _with_off(self, pending: _Pending) -> Shot | None:
        shot, where = pending.shot, pending.where
        if not self._offs:
            return shot
        offs = self._offs.get((shot.camera, shot.plane))
        if offs is None:
            self.left_out.append(
                f"{where}: no laser-off picture of plane {shot.plane!r} by camera {shot.camera!r} "
                "is in the recording, while there are some of others; import this part on its own"
            )
            return None
        stamp, off = min(offs, key=lambda pair: (abs(pair[0] - shot.stamp), pair[0]))
        if not pending.sure:
            read: Mapping[int, Picture] = dict(pending.source.read(sorted({shot.on, off})))
            appears = spot_appears(read[shot.on], read[off])
            if not appears:
                self.left_out.append(f"{where}: {_no_spot(appears, stamp - self._origin)}")
                return None
        return replace(shot, off=off, off_stamp=stamp)

    def _times(self, stop: Stop) -> str:
        first, last = ((t - self._origin) / NS_PER_S for t in (stop.first, stop.last))
        return f"{first:.2f} to {last:.2f} s"


def _no_spot(appears: bool | None, off: int) -> str:
    against = f"the laser-off picture at {off / NS_PER_S:.2f} s"
    if appears is None:
        return f"its pictures are all alike and differ from {against} by more than a spot"
    return f"no spot: its pictures are all alike and show no more light than {against}"


def _with_ids(shots: Sequence[Shot], n_cameras: int) -> tuple[Shot, ...]:
    width = max(3, len(str(shots[-1].stop)))
    return tuple(
        replace(
            shot,
            id=f"{shot.stop:0{width}d}" + (f"_{shot.camera}" if n_cameras > 1 else ""),
        )
        for shot in shots
    )


def _check_overlap(motion: Motion, source: PictureSource) -> None:
    if not len(source.stamps):
        raise DataError(f"{source.name}: there are no pictures")
    first, last = motion.span
    start, end = int(source.stamps[0]), int(source.stamps[-1])
    if start <= last and first <= end:
        return
    apart = start - last if start > last else end - first
    raise DataError(
        f"{source.name}: the pictures' stamps and those of the hand's poses do not overlap: "
        f"pictures {seconds_text(start)} to {seconds_text(end)} s, poses {seconds_text(first)} to "
        f"{seconds_text(last)} s, {duration_text(abs(apart))} apart. Are camera and robot on "
        "different clocks (--image-offset, or for bags --stamps received)?"
    )
