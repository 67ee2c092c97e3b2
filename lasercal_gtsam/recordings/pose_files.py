"""Pose files with stamps: TUM (``t tx ty tz qx qy qz qw``) and Kalibr (``ns,px,py,pz,qw,...``)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture_rows import LARGEST_NUMBER
from lasercal_gtsam.io.files import read_text
from lasercal_gtsam.io.wording import at_most
from lasercal_gtsam.recordings.motion import Motion, QuaternionOrder, chain, pose_series
from lasercal_gtsam.recordings.stamps import ns_from_integer, ns_from_seconds

PoseFormat = Literal["tum", "kalibr"]
Transform = Literal["T_base_hand", "T_hand_base"]


@dataclass(frozen=True)
class _Format:
    """How a line is written; ``columns`` says the order of its numbers, position in metres."""

    separator: str | None
    unit: Literal["s", "ns"]
    order: QuaternionOrder
    columns: str
    most_cells: int


_FORMATS = {
    "tum": _Format(None, "s", "quat_xyzw", "t_s tx ty tz qx qy qz qw", 8),
    # as Kalibr exports them; EuRoC's state files have nine more columns behind
    "kalibr": _Format(",", "ns", "quat_wxyz", "t_ns,px,py,pz,qw,qx,qy,qz", 17),
}


def read_pose_file(path: str | Path, form: PoseFormat, transform: Transform) -> Motion:
    """Read a TUM or Kalibr pose file as the hand's motion.

    Neither format says which frame is which, so the direction must be told.

    Parameters
    ----------
    path : the file; lines that begin with ``#`` do not count
    form : ``tum``: blanks between, seconds, x, y, z in metres, quaternion x, y, z, w. ``kalibr``
        (also EuRoC): commas between, nanoseconds, x, y, z in metres, quaternion w, x, y, z
    transform : what a line is: ``T_base_hand`` (the hand's pose in the base) or its inverse

    Raises
    ------
    DataError
        Each line that is not of that form, quaternions that are not unit, or no lines at all.
    """
    path = Path(path)
    layout = _FORMATS[form]
    problems: list[str] = []
    rows: list[list[float]] = []
    stamps: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        cells = [cell.strip() for cell in line.split(layout.separator)]
        if not any(cells) or line.lstrip().startswith("#"):
            continue
        found = _line(cells, layout)
        if isinstance(found, str):
            problems.append(f"{path.name}:{number}: {found}; expected {layout.columns}")
        else:
            stamps.append(found[0])
            rows.append(found[1])
    if problems:
        raise DataError(*at_most(problems, 5))
    if not rows:
        raise DataError(f"{path}: there are no poses; expected lines of {layout.columns}")
    numbers = np.array(rows)
    series = pose_series(
        path.name,
        np.array(stamps, dtype=np.int64),
        numbers[:, :3],
        numbers[:, 3:],
        layout.order,
    )
    return chain("base", "hand", [(series, transform == "T_hand_base")])


def _line(cells: list[str], layout: _Format) -> tuple[int, list[float]] | str:
    """Stamp and seven numbers of a line, or what is wrong with it."""
    if not 8 <= len(cells) <= layout.most_cells:
        between = "blanks" if layout.separator is None else "commas"
        return f"{len(cells)} numbers with {between} between them"
    read = ns_from_seconds if layout.unit == "s" else ns_from_integer
    stamp = read(cells[0])
    if stamp is None:
        return f"the stamp {cells[0]!r} is not in {'seconds' if layout.unit == 's' else 'whole ns'}"
    try:
        numbers = [float(cell) for cell in cells[1:8]]
    except ValueError:
        return f"{', '.join(cells[1:8])} are not all numbers"
    if not all(abs(number) <= LARGEST_NUMBER for number in numbers):  # NaN is not either
        return f"{', '.join(cells[1:8])}: numbers that no robot has"
    return stamp, numbers
