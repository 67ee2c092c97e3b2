"""Where chunks are run: in this process, in a pool of processes, on a Dask cluster.

All of them are `concurrent.futures.Executor`; nothing else of them is used, so that another one
(MPI, a batch queue) needs one small class here.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Protocol, TypeVar

from lasercal_gtsam.errors import DataError, SolveError
from lasercal_gtsam.io.calibration_file import program_version

T = TypeVar("T")

# one thread a process: the work is many small matrices, and the processes share the cores
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class Workers(Protocol):
    """How to get an executor, and how many chunks it can run at a time."""

    @property
    def count(self) -> int:
        """Chunks that run at the same time."""
        ...

    def open(self) -> AbstractContextManager[Executor]:
        """Give an executor; leaving the context ends it and drops what was not begun."""
        ...


@dataclass(frozen=True)
class OneProcess:
    """The process we are in, one chunk after the other; what a debugger wants."""

    count: int = 1

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Give an executor that has run a chunk when `submit` returns."""
        yield _AtOnce()


@dataclass(frozen=True)
class Processes:
    """A pool of fresh processes on this machine (started anew, not forked: see `multiprocessing`).

    A script that uses it needs ``if __name__ == "__main__":``, as with any process pool.
    """

    count: int

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Give a `ProcessPoolExecutor`."""
        with _single_threaded_children():
            pool = ProcessPoolExecutor(self.count, mp_context=get_context("spawn"))
            try:
                yield pool
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster at an address such as ``tcp://scheduler:8786``.

    Each worker needs this package in the same version; others are refused. Dask runs a chunk
    elsewhere when its worker dies.
    """

    address: str
    patience_s: float = 10.0

    @property
    def count(self) -> int:
        """Threads of all workers, as they are now."""
        with self._client() as client:
            return max(int(sum(client.nthreads().values())), 1)

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Give the executor of a client."""
        with self._client() as client:
            _refuse_other_versions(client.run(program_version))
            executor = client.get_executor(pure=False, retries=3)
            try:
                yield executor
            except _lost_cluster() as error:
                raise SolveError(
                    f"the cluster at {self.address} gave up: {error}. What was finished is kept in "
                    "the journal; run the same again to go on"
                ) from error
            finally:
                executor.shutdown(wait=False)

    @contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ImportError:
            raise DataError(
                "a cluster needs Dask: pip install 'lasercal-gtsam[study]' here and on its workers"
            ) from None
        try:
            client: Any = Client(  # type: ignore[no-untyped-call]
                self.address, timeout=self.patience_s, set_as_default=False
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise DataError(
                f"no cluster answers at {self.address!r} ({error}); expected the address of a Dask "
                "scheduler, such as tcp://host:8786"
            ) from None
        with client:
            yield client


def workers_for(jobs: int | None = None, cluster: str | None = None) -> Workers:
    """What a command line asks for.

    Parameters
    ----------
    jobs : processes on this machine; 1: this one; None: as many as it has cores for us
    cluster : address of a Dask scheduler instead

    Raises
    ------
    DataError
        ``jobs`` is not a number of processes, or both are given.
    """
    if cluster is not None:
        if jobs is not None:
            raise DataError("give either a number of processes or a cluster, not both")
        return Cluster(cluster)
    if jobs is None:
        jobs = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
        jobs = jobs or os.cpu_count() or 1
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise DataError(f"jobs: expected an integer >= 1, got {jobs!r}")
    return OneProcess() if jobs == 1 else Processes(jobs)


def _refuse_other_versions(there: Mapping[str, str]) -> None:
    """Results of two versions must not be mixed; ``there`` is worker -> version."""
    here = program_version()
    others = [f"{worker} has {version}" for worker, version in there.items() if version != here]
    if others:
        raise DataError(
            f"the cluster's workers need lasercal-gtsam {here} as here, but {', '.join(others)}; "
            "install the same there"
        )


def _lost_cluster() -> tuple[type[BaseException], ...]:
    from distributed import KilledWorker
    from distributed.comm.core import CommClosedError

    return KilledWorker, CommClosedError, CancelledError


def apart(function: Callable[..., object], *args: object) -> None:
    """Call a function in a fresh Python of its own, and wait for it.

    For what should leave its traces on the disk only: see `lasercal_gtsam.study`. Function and
    arguments are pickled; unlike a process pool it asks nothing of the calling script.

    Raises
    ------
    SolveError
        It failed there; says how.
    """
    program = "import pickle, sys; f, a = pickle.load(sys.stdin.buffer); f(*a)"
    paths = [path for path in sys.path if path]
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=pickle.dumps((function, args)),
        capture_output=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **dict.fromkeys(_THREADS, "1")},
        check=False,
    )
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines() or ["nothing was said"]
        raise SolveError(f"a run in a process of its own failed: {words[-1]}")


class _AtOnce(Executor):
    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
