"""Works whose runs other processes can find, count and die of."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.simulate.streams import NOISE, stream


def draw(spec: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Some numbers of the run's own stream; says in a folder that it was run."""
    _note(spec, k)
    time.sleep(spec.get("seconds", 0.0))
    numbers = stream(spec["seed"], NOISE, k).standard_normal(3)
    return {"run": k, "numbers": numbers.tolist()}


def die_once(spec: Mapping[str, Any], k: int) -> dict[str, Any]:
    """The same, but the first worker that gets run 7 is killed."""
    note = Path(spec["folder"]) / "died"
    if k == 7 and not note.exists():
        note.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(spec, k)


def die_always(spec: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Every worker that gets run 3 is killed."""
    if k == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(spec, k)


def fail(spec: Mapping[str, Any], k: int) -> float:
    """Run 5 has a bug."""
    return 1.0 / (5 - k)


def refuse(spec: Mapping[str, Any], k: int) -> float:
    """Run 2 finds the user's settings impossible."""
    if k == 2:
        raise DataError("the cell is too small", "the hand too large")
    return 0.0


def not_plain(spec: Mapping[str, Any], k: int) -> float:
    return float("nan")


def _note(spec: Mapping[str, Any], k: int) -> None:
    if "folder" in spec:
        with (Path(spec["folder"]) / f"run-{k}").open("a") as handle:
            handle.write(".")


def times_run(folder: Path, runs: int) -> list[int]:
    """How often each run was run."""
    files = [folder / f"run-{k}" for k in range(runs)]
    return [len(f.read_text()) if f.exists() else 0 for f in files]
