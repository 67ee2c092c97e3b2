"""Which working plane a picture shows: said by the user, in one of three ways."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.tables import read_table
from lasercal_gtsam.recordings.stamps import Stamps, as_stamps, last_before, ns_from_seconds


class PlaneNames(Protocol):
    """Names the plane of a picture by its stamp; None where none is said."""

    def __call__(self, stamp: int) -> str | None:
        """Plane at a stamp in nanoseconds."""


class OnePlane:
    """All pictures show the same plane."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, stamp: int) -> str | None:
        """Return the plane's name."""
        return self.name


class PlaneIntervals:
    """Planes by intervals of time, both ends included.

    Parameters
    ----------
    starts, ends : (N,) nanoseconds
    names : N planes
    """

    def __init__(self, starts: Stamps, ends: Stamps, names: Sequence[str]) -> None:
        self._starts, self._ends, self._names = as_stamps(starts), as_stamps(ends), list(names)

    def __call__(self, stamp: int) -> str | None:
        """Plane at a stamp."""
        for start, end, name in zip(self._starts, self._ends, self._names, strict=True):
            if start <= stamp <= end:
                return name
        return None


class LatchedPlanes:
    """Planes as a topic announces them: a name holds until the next one; an empty one says none.

    Parameters
    ----------
    stamps : (N,) nanoseconds, when each was received
    names : N planes
    """

    def __init__(self, stamps: Stamps, names: Sequence[str]) -> None:
        self._stamps, self._names = stamps, list(names)

    def __call__(self, stamp: int) -> str | None:
        """Plane at a stamp."""
        k = last_before(self._stamps, stamp)
        return None if k is None else self._names[k].strip() or None


def read_plane_intervals(path: str | Path, origin: int) -> PlaneIntervals:
    """Read a CSV table of intervals: columns ``plane`` and ``start_s, end_s`` or stamps.

    ``start_s, end_s`` are seconds since the recording's first stamp, ``start_stamp, end_stamp``
    seconds as in the messages' stamps.

    Parameters
    ----------
    path : the table
    origin : first stamp of the recording, nanoseconds

    Raises
    ------
    DataError
        Missing columns, cells that are no numbers, intervals that end before they begin or
        overlap, each with its line.
    """
    path = Path(path)
    table = read_table(path)
    absolute = "start_stamp" in table.columns or "end_stamp" in table.columns
    columns = ("start_stamp", "end_stamp") if absolute else ("start_s", "end_s")
    if not table.require(
        [*columns, "plane"],
        "which say when a plane is worked on (start_s, end_s: seconds since the recording's "
        "beginning; or start_stamp, end_stamp)",
    ):
        raise DataError(*table.problems())
    names = table.text("plane")
    offset = 0 if absolute else origin
    times = np.zeros((len(table), 2), dtype=np.int64)
    for row in range(len(table)):
        for k, column in enumerate(columns):
            value = ns_from_seconds(table.columns[column][row])
            if value is None:
                cell = table.columns[column][row]
                table.add_problem(row, f"{column}: expected seconds, got {cell!r}")
            else:
                times[row, k] = value + offset
        if times[row, 0] > times[row, 1]:
            table.add_problem(row, f"{columns[1]}: the interval ends before it begins")
    order = np.argsort(times[:, 0], kind="stable")
    for before, after in pairwise(order):
        if times[after, 0] <= times[before, 1] and names[before] != names[after]:
            table.add_problem(
                int(after), f"overlaps with the interval in line {table.lines[before]}"
            )
    if problems := table.problems():
        raise DataError(*problems)
    return PlaneIntervals(times[:, 0], times[:, 1], names)
