"""What is run, and how one worker runs a chunk of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from lasercal_gtsam.errors import DataError, LasercalError

Run = Callable[[Mapping[str, Any], int], Any]


@dataclass(frozen=True)
class Work:
    """A function of a run's number.

    Attributes
    ----------
    name : what it is, for messages and the journal
    function : ``function(spec, k) -> plain value`` for the run k; defined at the top of a module,
        so that other processes find it. What it returns is said in JSON: plain dicts, lists,
        strings, finite numbers, booleans, None. It depends on ``spec`` and k only
    spec : what every run is told, also plain; two works of one name and one spec are the same
    runs : how many, >= 0

    Raises
    ------
    DataError
        ``spec`` cannot be said in JSON, or ``runs`` is not a number of runs.
    """

    name: str
    function: Run
    spec: Mapping[str, Any]
    runs: int

    def __post_init__(self) -> None:
        if isinstance(self.runs, bool) or not isinstance(self.runs, int) or self.runs < 0:
            raise DataError(f"{self.name}: runs: expected an integer >= 0, got {self.runs!r}")
        try:
            said = plain(self.spec)
        except (TypeError, ValueError) as error:
            raise DataError(f"{self.name}: the settings cannot be said in JSON: {error}") from None
        object.__setattr__(self, "spec", said)


class Done(NamedTuple):
    """Results of the runs ``first`` to ``first + len(results) - 1``, and the seconds they took."""

    first: int
    results: list[Any]
    seconds: float


class RunError(Exception):
    """A run broke: a bug of its function, or of what it calls; ``__cause__`` says where."""


def run_chunk(function: Run, spec: Mapping[str, Any], first: int, last: int) -> Done:
    """Run ``first`` to ``last - 1``; this is what a worker is sent."""
    begin = time.perf_counter()
    results = []
    for k in range(first, last):
        try:
            results.append(plain(function(spec, k)))
        except LasercalError:  # what a user can mend, such as a cell in which nothing is seen
            raise
        except Exception as error:
            raise RunError(f"run {k} broke: {type(error).__name__}: {error}") from error
    return Done(first, results, time.perf_counter() - begin)


def plain(value: Any) -> Any:
    """The value as it comes back from a journal; TypeError or ValueError where JSON has no word."""
    return json.loads(json.dumps(value, allow_nan=False))
