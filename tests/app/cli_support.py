"""How the tests run the command line, in this process and in a fresh one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from lasercal_gtsam.cli.main import main

PROGRAM = "import sys; from lasercal_gtsam.cli.main import main; sys.exit(main())"


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


class Cli:
    """`lasercal` in this process; what it printed is captured."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys

    def __call__(self, *args: object) -> Outcome:
        self.capsys.readouterr()
        status = main([str(arg) for arg in args])
        return Outcome(status, *self.capsys.readouterr())

    def json(self, *args: object) -> Any:
        outcome = self(*args, "--json")
        assert outcome.status == 0, outcome.err
        return json.loads(outcome.out)


def in_fresh_process(*args: object, cwd: Path | None = None) -> Outcome:
    """`lasercal` as a user runs it."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *(str(arg) for arg in args)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment(),
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


def environment() -> dict[str, str]:
    """The tests' own environment, with this checkout's packages first."""
    paths = [path for path in sys.path if path and Path(path).is_dir()]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "80"}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}
