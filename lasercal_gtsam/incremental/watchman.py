"""The change detector over a running estimate: spots by number in, the first affected one out."""

from __future__ import annotations

from collections import deque

import numpy as np
from lasercal_factors.change_arrays import Looks

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.incremental.detector import Detector
from lasercal_gtsam.incremental.filter import Filter
from lasercal_gtsam.incremental.innovation import Innovation
from lasercal_gtsam.incremental.store import LEFT_OUT, Path, SpotStore

# looks whose spots are remembered; the detector's own window is shorter
_REMEMBERED = 4096


class Watchman:
    """Watches spot by spot whether something has changed; see `Detector`.

    Parameters
    ----------
    store : spots so far, with their marks: how often each part had outliers
    cell : the parts
    outliers, good : older spots that are in the store no more
    """

    def __init__(self, store: SpotStore, cell: Cell, outliers: float, good: float) -> None:
        counts = len(cell.cameras), len(cell.lasers), len(cell.planes)
        self._detector = Detector.start(*counts, outliers=outliers, good=good)
        self._numbers: deque[int] = deque(maxlen=_REMEMBERED)
        self._index: dict[Path, tuple[int, int, int]] = {}
        self._cell = cell
        self._look = Looks(
            e=np.empty((1, 2)),
            who=np.empty((1, 3), np.int64),
            by_camera=np.empty((1, 2, 6)),
            by_laser=np.empty((1, 2, 4)),
            by_plane=np.empty((1, 2, 3)),
            area=np.empty(1),
            dof=np.empty(1),
        )
        if len(store):
            who = np.array([self._who(path) for path in store.paths], dtype=np.int64)
            outlier = store.marks() == LEFT_OUT
            self._detector.remember(who[store.path_numbers()], outlier)

    @property
    def outlier_rate(self) -> float:
        """Running share of outliers."""
        return self._detector.outlier_rate

    def look(self, number: int, store: SpotStore, filter: Filter, seen: Innovation) -> int | None:
        """Take in a spot; the number of the first affected one, if something has changed."""
        path = store.path_of(number)
        width, height = store.image_size[path[0]]
        self._numbers.append(number)
        look = self._look
        look.e[0], look.who[0] = seen.e, self._who(path)
        look.by_camera[0] = seen.by_parts[:, :6]
        look.by_laser[0] = seen.by_parts[:, 6:10]
        look.by_plane[0] = seen.by_parts[:, 10:]
        look.area[0], look.dof[0] = width * height / seen.area, max(filter.dof, 1.0)
        (verdict,) = self._detector.look_many(look)
        if verdict.since is None:
            return None
        back = self._detector.number - verdict.since
        return self._numbers[-min(back, len(self._numbers))]

    def cover(self, cell: Cell) -> None:
        """Watch further parts, which come after those there are."""
        self._cell, self._index = cell, {}
        self._detector.cover(len(cell.cameras), len(cell.lasers), len(cell.planes))

    def forgive(self, since: int | None = None) -> None:
        """Forget all evidence; from the spot ``since`` on nothing counts as an outlier any more."""
        look = None
        if since is not None:
            later = sum(number >= since for number in self._numbers)
            look = self._detector.number - later
        self._detector.reset(look)

    def _who(self, path: Path) -> tuple[int, int, int]:
        found = self._index.get(path)
        if found is None:
            camera, laser, plane, _ = path
            cell = self._cell
            found = self._index[path] = (
                list(cell.cameras).index(camera),
                list(cell.lasers).index(laser),
                list(cell.planes).index(plane),
            )
        return found
