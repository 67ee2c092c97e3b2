"""The spots of a running calibration: 112 bytes each, and which of them the estimate uses.

Segments of constant size are allocated as they are needed and never copied, so that a new spot
costs the same whatever came before. Old segments can be let go.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import whitening_from_covariance
from lasercal_factors.stream_kernels import HELD_BACK, LEFT_OUT, RECORD, USED

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations

SEGMENT = 1 << 15
# camera, laser, plane, and whether the pixel covariance was stated (else it is an assumed one)
Path = tuple[str, str, str, bool]
Slice = tuple[Array, npt.NDArray[np.int32], npt.NDArray[np.uint8]]

__all__ = ["HELD_BACK", "LEFT_OUT", "SEGMENT", "USED", "Path", "SpotStore"]


class SpotStore:
    """Spots by number, from `first` to `end`; numbers never change, old ones go away."""

    def __init__(self, image_size: dict[str, tuple[int, int]]) -> None:
        self.image_size = dict(image_size)
        self.paths: list[Path] = []
        self.first = 0
        self.end = 0
        self._numbers: dict[Path, int] = {}
        self._segments: dict[int, tuple[Array, npt.NDArray[np.int32], npt.NDArray[np.uint8]]] = {}
        self._labels: dict[int, list[str]] = {}

    def __len__(self) -> int:
        return self.end - self.first

    def append(
        self, observations: Observations, sigma_px: float = 1.0, mark: int = HELD_BACK
    ) -> range:
        """Store spots; those without a covariance count with ``sigma_px``. The numbers they got."""
        stated = ~np.isnan(observations.cov_uv[:, 0, 0])
        records = records_of(observations, stated, sigma_px)
        self.image_size.update(observations.image_size)
        names = (observations.camera, observations.laser, observations.plane, stated)
        numbers = [self._path(path) for path in zip(*(x.tolist() for x in names), strict=True)]
        start, labels = self.end, observations.id.tolist()
        done = 0
        while done < len(records):
            at = self.end % SEGMENT
            space, path, marks = self._segment(self.end // SEGMENT)
            count = min(len(records) - done, SEGMENT - at)
            space[at : at + count] = records[done : done + count]
            path[at : at + count] = numbers[done : done + count]
            marks[at : at + count] = mark
            self._labels[self.end // SEGMENT] += labels[done : done + count]
            self.end += count
            done += count
        return range(start, self.end)

    def assume(self, sigma_px: float) -> None:
        """Let all spots without a covariance of their own count with this sigma from now on."""
        stated = np.array([path[3] for path in self.paths], dtype=np.bool_)
        for _, (records, path, _) in self.slices(self.first, self.end):
            records[~stated[path], 2:5] = (1.0 / sigma_px, 0.0, 1.0 / sigma_px)

    def slices(self, begin: int, end: int) -> Iterator[tuple[int, Slice]]:
        """Views of the spots begin ... end-1, piece by piece: first number, then the arrays."""
        while begin < end:
            number, at = divmod(begin, SEGMENT)
            stop = min(SEGMENT, at + end - begin)
            space, path, marks = self._segments[number]
            yield begin, (space[at:stop], path[at:stop], marks[at:stop])
            begin += stop - at

    def mark(self, begin: int, end: int, mark: int) -> None:
        """Set what the estimate does with these spots."""
        if end == begin + 1:
            self._segments[begin // SEGMENT][2][begin % SEGMENT] = mark
            return
        for _, (_, _, marks) in self.slices(begin, end):
            marks[:] = mark

    def mark_each(self, begin: int, marks: npt.NDArray[np.uint8]) -> None:
        """Set what the estimate does with each spot from ``begin`` on."""
        for first, (_, _, stored) in self.slices(begin, begin + len(marks)):
            stored[:] = marks[first - begin : first - begin + len(stored)]

    def marks(self, begin: int | None = None, end: int | None = None) -> npt.NDArray[np.uint8]:
        """Marks of the spots begin ... end-1 (all that are stored, if left out)."""
        parts = [s[2] for _, s in self.slices(self._from(begin), self._to(end))]
        return np.concatenate(parts) if parts else np.empty(0, np.uint8)

    def path_numbers(self) -> npt.NDArray[np.int32]:
        """Number of the path of each spot that is stored."""
        parts = [s[1] for _, s in self.slices(self.first, self.end)]
        return np.concatenate(parts) if parts else np.empty(0, np.int32)

    def record(self, number: int) -> tuple[Array, np.int32]:
        """The row of a spot, and the number of its path."""
        records, path, _ = self._segments[number // SEGMENT]
        return records[number % SEGMENT], path[number % SEGMENT]

    def mark_of(self, number: int) -> int:
        """What the estimate does with a spot."""
        return int(self._segments[number // SEGMENT][2][number % SEGMENT])

    def label(self, number: int) -> str:
        """Label of a spot."""
        return self._labels[number // SEGMENT][number % SEGMENT]

    def path_of(self, number: int) -> Path:
        """Which way a spot went."""
        return self.paths[int(self._segments[number // SEGMENT][1][number % SEGMENT])]

    def observations(self, begin: int | None = None, end: int | None = None) -> Observations:
        """The spots begin ... end-1 (all that are stored, if left out) as they were given."""
        begin, end = self._from(begin), self._to(end)
        return self._given([s for _, s in self.slices(begin, end)], range(begin, end))

    def chosen(self, numbers: Sequence[int]) -> Observations:
        """Those spots as they were given."""
        return self._given([s for n in numbers for _, s in self.slices(n, n + 1)], numbers)

    def _given(self, pieces: Sequence[Slice], numbers: Sequence[int]) -> Observations:
        records = np.concatenate([p[0] for p in pieces]) if pieces else np.empty((0, RECORD))
        index = np.concatenate([p[1] for p in pieces]) if pieces else np.empty(0, np.int32)
        names = np.array([path[:3] for path in self.paths], dtype=np.str_).reshape(-1, 3)[index]
        stated = np.array([path[3] for path in self.paths], dtype=np.bool_)[index]
        uv, cov_uv, T = split_records(records)
        cov_uv[~stated] = np.nan
        return Observations(
            uv=uv,
            cov_uv=cov_uv,
            T_base_hand=T,
            camera=names[:, 0],
            laser=names[:, 1],
            plane=names[:, 2],
            id=np.array([self.label(k) for k in numbers], dtype=np.str_),
            image_size=self.image_size,
        )

    def forget(self, end: int) -> None:
        """Let the spots before ``end`` go."""
        self.first = max(self.first, end)
        for number in [n for n in self._segments if (n + 1) * SEGMENT <= self.first]:
            del self._segments[number], self._labels[number]

    def _from(self, begin: int | None) -> int:
        return self.first if begin is None else begin

    def _to(self, end: int | None) -> int:
        return self.end if end is None else end

    def _path(self, path: Path) -> int:
        number = self._numbers.get(path)
        if number is None:
            number = self._numbers[path] = len(self.paths)
            self.paths.append(path)
        return number

    def _segment(self, number: int) -> Slice:
        if number not in self._segments:
            # pages are touched, and memory is used, only as spots arrive
            self._segments[number] = (
                np.empty((SEGMENT, RECORD)),
                np.empty(SEGMENT, np.int32),
                np.empty(SEGMENT, np.uint8),
            )
            self._labels[number] = []
        return self._segments[number]


def records_of(observations: Observations, stated: npt.NDArray[np.bool_], sigma_px: float) -> Array:
    """Rows of `lasercal_factors.stream_kernels`, (N, 14).

    ``stated`` (N,): spots with a pixel covariance of their own; the others have ``sigma_px``.
    """
    T = observations.T_base_hand
    records = np.empty((len(observations), RECORD))
    records[:, :2] = observations.uv
    records[:, 2:5] = (1.0 / sigma_px, 0.0, 1.0 / sigma_px)
    if stated.any():
        records[stated, 2:5] = whitening_from_covariance(observations.cov_uv[stated])
    records[:, 5:8], records[:, 8:11] = T[:, :3, 0], T[:, :3, 1]
    records[:, 11:14] = T[:, :3, 3]
    return records


def split_records(records: Array) -> tuple[Array, Array, Array]:
    """Pixels (N, 2), covariances (N, 2, 2) and hand poses (N, 4, 4) of rows of the store."""
    w00, w01, w11 = records[:, 2:5].T
    W = np.zeros((len(records), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = 1 / w00, -w01 / (w00 * w11), 1 / w11
    T = np.tile(np.eye(4), (len(records), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 3] = records[:, 5:8], records[:, 8:11], records[:, 11:14]
    T[:, :3, 2] = np.cross(records[:, 5:8], records[:, 8:11])
    return records[:, :2], W @ np.swapaxes(W, 1, 2), T
