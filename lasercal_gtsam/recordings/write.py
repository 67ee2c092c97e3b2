"""Write what was chosen from a recording as a capture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import CAPTURE_FILE
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.io.files import whole_folder, write_text
from lasercal_gtsam.io.pictures import Picture, write_png
from lasercal_gtsam.io.plain import plain, to_json
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.recordings.plan import Plan, Shot
from lasercal_gtsam.recordings.sources import PictureSource
from lasercal_gtsam.recordings.stamps import NS_PER_S

RECORDING_FILE = "recording.json"
RECORDING_FORMAT = "lasercal-recording"
_ON, _OFF = "images/{id}.png", "images/{id}_off.png"


def write_recording(
    folder: str | Path,
    plan: Plan,
    sources: Sequence[PictureSource],
    *,
    origin: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a capture that `load_capture` reads, and ``recording.json`` that says whence it is.

    Pictures become PNG files with every pixel as it was; poses are written with all digits, in mm
    and as quaternions w, x, y, z. The folder appears whole or stays empty.

    Parameters
    ----------
    folder : a new or empty folder
    plan : from `plan_capture`
    sources : those that it was made of
    origin : what goes into ``recording.json`` beside the rows: files, topics, frames
    progress : called with (rows written, rows to write)

    Returns
    -------
    Path
        Of ``capture.yaml``.

    Raises
    ------
    DataError
        The folder is not empty or cannot be written to; a picture cannot be read or is of another
        size than the others of its camera.
    """
    by_camera = {source.camera: source for source in sources}
    with_off = any(shot.off is not None for shot in plan.shots)
    sizes: dict[str, tuple[int, int]] = {}
    with whole_folder(folder, last=CAPTURE_FILE) as staging:
        (staging / _ON).parent.mkdir()
        for done, shot in enumerate(plan.shots, start=1):
            for pattern, picture in _pictures(shot, by_camera[shot.camera], sizes):
                write_png(staging / pattern.format(id=shot.id), picture)
            if progress is not None:
                progress(done, len(plan.shots))
        write_text(staging / RECORDING_FILE, to_json(plain(_document(plan, origin or {}))) + "\n")
        write_capture(
            staging,
            _rows(plan.shots, sizes),
            transform="T_base_hand",
            length="mm",
            rotation="quat_wxyz",
            with_spots=False,
            images={"on": _ON, "off": _OFF} if with_off else {"on": _ON},
        )
    return Path(folder) / CAPTURE_FILE


def _pictures(
    shot: Shot, source: PictureSource, sizes: dict[str, tuple[int, int]]
) -> list[tuple[str, Picture]]:
    which = [shot.on] if shot.off is None else [shot.on, shot.off]
    read = dict(source.read(sorted(which)))
    for picture in read.values():
        height, width = picture.shape[:2]
        expected = sizes.setdefault(shot.camera, (width, height))
        if expected != (width, height):
            raise DataError(
                f"{source.name}: the picture of stop {shot.stop} is {width} x {height} pixels, "
                f"those before have {expected[0]} x {expected[1]}; one recording, one size"
            )
    return [(name, read[k]) for name, k in zip((_ON, _OFF), which, strict=False)]


def _rows(shots: Sequence[Shot], sizes: Mapping[str, tuple[int, int]]) -> Observations:
    return Observations.from_arrays(
        np.zeros((len(shots), 2)),  # not written: the spots are in the pictures
        np.stack([shot.T_base_hand for shot in shots]),
        plane=[shot.plane for shot in shots],
        camera=[shot.camera for shot in shots],
        id=[shot.id for shot in shots],
        image_size=sizes,
    )


def _document(plan: Plan, origin: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "format": RECORDING_FORMAT,
        "version": 1,
        **origin,
        "first_stamp_ns": plan.origin,
        "stops": len(plan.stops),
        "rows": [
            {
                "id": shot.id,
                "stop": shot.stop,
                "stop_s": [
                    (t - plan.origin) / NS_PER_S
                    for t in (plan.stops[shot.stop - 1].first, plan.stops[shot.stop - 1].last)
                ],
                "stamp_ns": shot.stamp,
                "off_stamp_ns": shot.off_stamp,
                "off_of_same_stop": shot.off_own,
                "pictures": shot.n_pictures,
            }
            for shot in plan.shots
        ],
        "left_out": plan.left_out,
        "notes": plan.notes,
    }
