"""`examine`: everything that can be said of a capture before anybody trusts a calibration of it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lasercal_gtsam.check.causes import grazing_shots
from lasercal_gtsam.check.diagnosis import Diagnosis, sentences
from lasercal_gtsam.check.picture import Coverage, coverage, lines_of_spots
from lasercal_gtsam.check.poses import PoseFacts, pose_facts
from lasercal_gtsam.check.readings import RawPoses, pose_readings, swapped_pixels
from lasercal_gtsam.check.weakness import Weakness, weaknesses
from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD
from lasercal_gtsam.errors import DataError, DegenerateError, SolveError
from lasercal_gtsam.io.capture import Capture, capture_file, load_capture
from lasercal_gtsam.io.capture_head import CaptureHead, read_head
from lasercal_gtsam.io.capture_rows import USED, Rows, read_rows
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.units import RAD_PER_DEG

Show = Callable[[int, int], None]
Bar = Callable[[str], AbstractContextManager[Show]]


@dataclass(frozen=True)
class Examination:
    """What `examine` found.

    Attributes
    ----------
    path : ``capture.yaml``
    poses : what the hand poses say
    spots : number of spots that were used; 0: the poses were judged alone
    not_looked_at : number of pictures that could have been looked at and were not
    coverage : where the spots lie
    diagnosis : which reading of the numbers fits, or None if that was not asked
    reading : the diagnosis in sentences
    fit : status sentence of a calibration, or None where none was made
    weak : directions that the spots hardly determine
    problems : why no calibration of this capture can be trusted, one sentence each
    remarks : what should be better, or looks odd
    """

    path: Path
    poses: PoseFacts
    spots: int
    not_looked_at: int
    coverage: tuple[Coverage, ...]
    diagnosis: Diagnosis | None
    reading: tuple[str, ...]
    fit: str | None
    weak: tuple[Weakness, ...]
    problems: tuple[str, ...]
    remarks: tuple[str, ...]


def examine(
    path: str | Path, *, pictures: bool = False, readings: bool = True, bar: Bar
) -> Examination:
    """Check a capture: its poses, and as far as there are spots its conventions and its geometry.

    Parameters
    ----------
    path : ``capture.yaml`` or its folder; it may have neither spots nor pictures yet
    pictures : look for spots in pictures
    readings : ask which reading of the poses fits; takes some seconds
    bar : called with a label; gives what shows (done, total) meanwhile

    Raises
    ------
    DataError
        The capture cannot be read.
    """
    path = capture_file(Path(path))
    head, _ = read_head(path)
    rows = _rows(head, path)
    tolerance = max(GROUP_TOLERANCE_RAD, 4 * _hand_sigma_rad(head))
    facts = pose_facts(
        rows.T_base_hand,
        np.array(rows.planes),
        np.array(rows.cameras),
        np.array(rows.lasers),
        rows.ids,
        tolerance,
    )
    found = Examination(
        path, facts, 0, 0, (), None, (), None, (), facts.missing, (*facts.odd, *rows.warnings)
    )
    if not rows.has_spots and head.images is None:
        return found
    try:
        capture = load_capture(path)
    except DataError as error:
        if rows.has_spots or pictures:
            raise
        remark = f"the pictures cannot be read yet: {error.problems[0]}"
        return replace(found, remarks=(*found.remarks, remark))
    return _with_spots(
        replace(found, remarks=(*facts.odd, *capture.warnings)), capture, pictures, readings, bar
    )


def _rows(head: CaptureHead, path: Path) -> Rows:
    try:
        return read_rows(head, path.parent)
    except DataError as error:
        hint = swapped_pixels(head, path.parent)
        raise DataError(*error.problems, *hint) from None


def _hand_sigma_rad(head: CaptureHead) -> float:
    return 0.0 if head.noise is None else head.noise.hand_rotation_deg * RAD_PER_DEG


def _with_spots(
    found: Examination, capture: Capture, pictures: bool, readings: bool, bar: Bar
) -> Examination:
    waiting = sum(
        image is not None and not verdict
        for image, verdict in zip(capture.images_on, capture.verdict, strict=True)
    )
    notes: tuple[str, ...] = ()
    if pictures:
        with bar("Looking at pictures") as show:
            account = capture.detections(progress=show)
        notes, waiting = account.notes, 0
        seen: Observations | None = capture.observations(account=account)
    else:
        seen = _given_spots(capture)
    if seen is None:
        return replace(found, not_looked_at=waiting)
    found = replace(
        found,
        spots=len(seen),
        not_looked_at=waiting,
        coverage=coverage(seen),
        remarks=(*found.remarks, *notes, *lines_of_spots(seen)),
    )
    if found.problems:
        return found
    try:
        if readings:
            found = _diagnosed(found, capture, seen, bar)
            if found.problems:
                return found
        return _solved(found, capture, seen)
    except (DegenerateError, SolveError) as error:
        return replace(found, problems=(*found.problems, str(error)))


def _given_spots(capture: Capture) -> Observations | None:
    """The spots of the tables; None if there are none."""
    given = np.array([verdict == USED for verdict in capture.verdict])
    if not given.any():
        return None
    return Observations(
        uv=capture.uv[given],
        cov_uv=capture.cov_uv[given],
        T_base_hand=capture.T_base_hand[given],
        camera=capture.cameras[given],
        laser=capture.lasers[given],
        plane=capture.planes[given],
        id=capture.ids[given],
        image_size=capture.image_size,
        stop=None if capture.stops is None else capture.stops[given],
    )


def _diagnosed(found: Examination, capture: Capture, seen: Observations, bar: Bar) -> Examination:
    from lasercal_gtsam.check.doctor import diagnose

    raw = RawPoses.of_capture(capture.path)
    row_of = {name: row for row, name in enumerate(raw.ids)}
    rows = [row_of[name] for name in seen.id.tolist()]
    poses = [replace(p, T_base_hand=p.T_base_hand[rows]) for p in pose_readings(raw)]
    with bar("Reading the poses in other ways") as show:
        diagnosis = diagnose(seen, poses, capture.options(), show)
    reading = tuple(sentences(diagnosis))
    wrong = diagnosis.verdict in ("other", "none")
    return replace(
        found, diagnosis=diagnosis, reading=reading, problems=reading[:1] if wrong else ()
    )


def _solved(found: Examination, capture: Capture, seen: Observations) -> Examination:
    from lasercal_gtsam.api import calibrate

    result = calibrate(seen, options=capture.options())
    trouble = () if result.fit.converged else (result.fit.status,)
    return replace(
        found,
        fit=result.fit.status,
        weak=weaknesses(result) if result.fit.converged else (),
        problems=trouble,
        remarks=(
            *found.remarks,
            *(note for note in result.observability.notes if note not in result.fit.status),
            *(grazing_shots(result.cell, seen) if result.fit.converged else ()),
        ),
    )
