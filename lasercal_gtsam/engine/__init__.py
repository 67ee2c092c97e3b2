"""Many independent runs, on one process, on all cores or on a cluster, and never one twice.

A `Work` is a function of a number, and how many numbers. `run_all` hands them out in chunks of
about a second to any `concurrent.futures.Executor`, journals each finished chunk, and returns the
results in the order of the runs. Since a run draws its random numbers from its own number alone
(`lasercal_gtsam.simulate.streams.stream`), the results depend neither on the engine nor on the
chunks, the order or an interruption.
"""

from __future__ import annotations

from lasercal_gtsam.engine.runner import Progress, Results, run_all
from lasercal_gtsam.engine.work import Work
from lasercal_gtsam.engine.workers import (
    Cluster,
    OneProcess,
    Processes,
    Workers,
    apart,
    workers_for,
)

__all__ = [
    "Cluster",
    "OneProcess",
    "Processes",
    "Progress",
    "Results",
    "Work",
    "Workers",
    "apart",
    "run_all",
    "workers_for",
]
