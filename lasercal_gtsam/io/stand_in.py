"""Laser-off frames for rows that have none: the median of the laser-on pictures of their scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.errors import DataError, DetectionError
from lasercal_gtsam.io.pictures import Picture

MIN_ROWS = 5
MAX_PICTURES = 15
WITHOUT = "looked at without an off frame"
_ALONE = "without an off frame every bright thing looks like a spot"

Scene = tuple[str, str]


@dataclass(frozen=True, eq=False)
class StandIn:
    """What a scene has for an off frame: a picture or None, and the remark for each of its rows."""

    frame: Picture | None
    remark: str


_NOTHING = StandIn(None, "")


class StandIns:
    """Off frames of scenes, each made when first asked for and dropped after its last row.

    Scenes with fewer than 5 rows get none. Nor do those whose spots lie on each other
    (`lasercal_gtsam.detect.spots_in_median`): the median would hold, hide and shift them.

    Parameters
    ----------
    scenes : row to (camera, plane), for the rows without a laser-off picture
    read : laser-on picture of a row; raises `DataError`
    saturation : pixel value from which a pixel is saturated, if known
    """

    def __init__(
        self,
        scenes: Mapping[int, Scene],
        read: Callable[[int], Picture],
        saturation: float | None = None,
    ) -> None:
        self._scenes = dict(scenes)
        self._read = read
        self._saturation = saturation
        self._rows: dict[Scene, list[int]] = {}
        for row, scene in self._scenes.items():
            self._rows.setdefault(scene, []).append(row)
        self._left = {scene: len(rows) for scene, rows in self._rows.items()}
        self._ready: dict[Scene, StandIn] = {}
        self.notes: list[str] = []
        self.remarks: dict[int, str] = {}

    def frame(self, row: int, on: Picture) -> Picture | None:
        """Off frame for a row, or None; to be asked for once a row.

        What was done is added to ``notes`` (a sentence for each scene) and ``remarks`` (for the
        row).
        """
        scene = self._scenes.get(row)
        if scene is None:
            return None
        if scene not in self._ready:
            self._ready[scene] = self._make(scene)
        made = self._ready[scene]
        self._left[scene] -= 1
        if not self._left[scene]:
            del self._ready[scene]
        frame, remark = made.frame, made.remark
        if frame is not None and (frame.shape, frame.dtype) != (on.shape, on.dtype):
            remark = (
                f"{WITHOUT}: the picture is {on.dtype} {on.shape}, those of "
                f"the other rows are {frame.dtype} {frame.shape}"
            )
            frame = None
        if remark:
            self.remarks[row] = remark
        return frame

    def _make(self, scene: Scene) -> StandIn:
        rows = self._rows[scene]
        if len(rows) < MIN_ROWS:
            return _NOTHING
        try:
            pictures = [self._read(row) for row in evenly(rows)]
        except DataError:
            return _NOTHING  # the row itself will say so
        frame, why = median_of(pictures, self._saturation)
        about = f"{_named(scene)}: {len(rows)} rows have no laser-off picture"
        if why is not None:
            self.notes.append(
                f"{about}, and the median of their laser-on pictures cannot stand in for it "
                f"({why}); {_ALONE}"
            )
            return StandIn(None, f"{WITHOUT}: {why}")
        self.notes.append(
            f"{about}; the median of {len(pictures)} of their laser-on pictures stands in for it"
        )
        return StandIn(frame, f"off frame: median of {len(pictures)} laser-on pictures")


def median_of(
    pictures: Sequence[Picture], saturation: float | None
) -> tuple[Picture | None, str | None]:
    """The median of laser-on pictures of a scene, or None and why it cannot stand in."""
    from lasercal_gtsam.detect.options import DetectionOptions
    from lasercal_gtsam.detect.reference import median_frame, spots_in_median

    try:
        frame = median_frame(pictures)
        options = DetectionOptions(saturation_level=saturation)
        why = spots_in_median(frame, pictures, options)
    except DetectionError as error:
        why = str(error)
    return (frame, None) if why is None else (None, why)


def evenly(rows: list[int]) -> list[int]:
    """Rows spread evenly from first to last: an odd number, which has a middle; at most 15."""
    count = min(MAX_PICTURES, len(rows) - (len(rows) + 1) % 2)
    return [rows[k] for k in np.rint(np.linspace(0, len(rows) - 1, count)).astype(int)]


def _named(scene: Scene) -> str:
    camera, plane = scene
    return f"camera {camera!r}, plane {plane!r}"
