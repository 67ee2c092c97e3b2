"""Handing out chunks, keeping what is finished, and going on after a worker died."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from lasercal_gtsam.engine.record import Record
from lasercal_gtsam.engine.work import Done, RunError, Work, run_chunk
from lasercal_gtsam.engine.workers import OneProcess, Workers
from lasercal_gtsam.errors import SolveError

CHUNK_SECONDS = 1.0
# a chunk holds at most so many times the runs of the longest before it: the first ones compile
_GROWTH = 4
# chunks handed out beyond those that run, so that no worker waits for the driver
_SPARE = 1
# a run that was in flight so often when a worker died is not handed out again
_MOST_DEATHS = 3


class Progress(NamedTuple):
    """How far it is: runs finished (those found in the journal too), of all, and seconds left.

    ``seconds_left`` is NaN until the first chunk has come back.
    """

    done: int
    runs: int
    seconds_left: float


@dataclass(frozen=True)
class Results:
    """What came out, in the order of the runs.

    Attributes
    ----------
    values : one for each run
    resumed : runs that were in the journal already
    executed : runs finished by this call; with ``resumed`` all of them
    deaths : how often workers died and were replaced
    """

    values: tuple[Any, ...]
    resumed: int
    executed: int
    deaths: int

    @property
    def digest(self) -> str:
        """SHA-256 of the results: the same whatever ran them, however often it was stopped."""
        said = json.dumps(self.values, allow_nan=False, separators=(",", ":"), sort_keys=True)
        return hashlib.sha256(said.encode()).hexdigest()


def run_all(
    work: Work,
    workers: Workers | None = None,
    *,
    journal: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    chunk_seconds: float = CHUNK_SECONDS,
    prepare: Callable[[], object] | None = None,
) -> Results:
    """Run everything that the journal does not hold yet.

    Parameters
    ----------
    work : what to run
    workers : where; this process by default
    journal : file of finished chunks, begun if there is none; with more runs than last time only
        the new ones are run
    progress : called after each chunk
    chunk_seconds : how long a chunk should take
    prepare : called before any worker begins, if there is anything to run

    Returns
    -------
    Results

    Raises
    ------
    DataError
        The journal belongs to another work, or cannot be written; no cluster answers.
    SolveError
        Workers died again and again at the same runs; names them.
    LasercalError
        That of a run, as it is. What was finished before is in the journal.
    RunError
        A run raised anything else: a bug. The same.
    """
    workers = workers or OneProcess()
    with nullcontext() if journal is None else Record(journal, work) as record:
        found = {} if record is None else {k: v for k, v in record.found.items() if k < work.runs}
        driver = _Driver(work, record, dict(found), progress, chunk_seconds)
        if prepare is not None and len(found) < work.runs:
            prepare()
        deaths = driver.finish(workers)
        values = tuple(driver.values[k] for k in range(work.runs))
    return Results(values, len(found), work.runs - len(found), deaths)


class _Driver:
    def __init__(
        self,
        work: Work,
        record: Record | None,
        values: dict[int, Any],
        progress: Callable[[Progress], None] | None,
        chunk_seconds: float,
    ) -> None:
        self.values = values
        self._work, self._record, self._progress = work, record, progress
        self._chunk_seconds = chunk_seconds
        self._left = deque(_gaps(values, work.runs))
        self._paces: deque[float] = deque(maxlen=20)  # seconds a run, of the last chunks
        self._size = 1
        self._began, self._before = time.monotonic(), len(values)
        self._deaths: Counter[int] = Counter()

    def finish(self, workers: Workers) -> int:
        """Run what is left; returns how often the executor broke."""
        deaths = 0
        while self._left:
            count = workers.count
            with workers.open() as executor:
                if not self._drain(executor, count):
                    deaths += 1
        return deaths

    def _drain(self, executor: Executor, count: int) -> bool:
        """Work through what is left; False where the executor broke, with the rest put back."""
        flying: dict[Future[Done], tuple[int, int]] = {}
        try:
            while self._left or flying:
                while self._left and len(flying) < (count + _SPARE if count > 1 else 1):
                    first, last = self._next_chunk(count)
                    task = (self._work.function, self._work.spec, first, last)
                    try:
                        flying[executor.submit(run_chunk, *task)] = (first, last)
                    except BaseException:
                        self._left.appendleft((first, last))
                        raise
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    done = future.result()
                    del flying[future]
                    self._take(done)
        except BrokenExecutor:
            lost: list[int] = []
            for future, chunk in flying.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    self._take(future.result())
                else:
                    lost += range(*chunk)
            self._put_back(lost)
            return False
        except BaseException:
            for future in flying:
                future.cancel()
            raise
        return True

    def _next_chunk(self, count: int) -> tuple[int, int]:
        first, last = self._left.popleft()
        size = 1
        if self._paces:
            wanted = int(self._chunk_seconds / max(median(self._paces), 1e-9))
            share = -(-(self._work.runs - len(self.values)) // (2 * count))
            size = max(1, min(wanted, _GROWTH * self._size, share))
            self._size = max(size, self._size)
        if first + size < last:
            self._left.appendleft((first + size, last))
            last = first + size
        return first, last

    def _take(self, done: Done) -> None:
        if self._record is not None:
            self._record.keep(done)
        self.values.update(enumerate(done.results, done.first))
        self._paces.append(done.seconds / len(done.results))
        if self._progress is not None:
            count = len(self.values)
            pace = (time.monotonic() - self._began) / max(count - self._before, 1)
            left = pace * (self._work.runs - count)
            self._progress(Progress(count, self._work.runs, left))

    def _put_back(self, lost: list[int]) -> None:
        """Hand out again, one by one, what was in flight when a worker died."""
        self._deaths.update(lost)
        hopeless = [str(k) for k in sorted(lost) if self._deaths[k] >= _MOST_DEATHS]
        if hopeless:
            raise SolveError(
                f"{self._work.name}: workers died {_MOST_DEATHS} times while they had run "
                f"{', '.join(hopeless)}. Too little memory, or a crash of a library there? What "
                "was finished is kept; fewer processes need less memory"
            )
        self._left.extendleft((k, k + 1) for k in sorted(lost, reverse=True))


def _gaps(values: dict[int, Any], runs: int) -> Iterator[tuple[int, int]]:
    """Stretches (first, last + 1) of runs that have no value yet."""
    first = None
    for k in range(runs + 1):
        missing = k < runs and k not in values
        if missing and first is None:
            first = k
        elif not missing and first is not None:
            yield first, k
            first = None


__all__ = ["CHUNK_SECONDS", "Progress", "Results", "RunError", "run_all"]
