"""Many captures in one call: each calibrated as if it were the only one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import click

from lasercal_gtsam.cli.console import print_json, progress, warn
from lasercal_gtsam.errors import DataError, LasercalError


def calibrate_many(
    captures: Sequence[Path],
    output: Path | None,
    page: Path | None,
    as_json: bool,
    jobs: int | None,
    cluster: str | None,
    settings: Mapping[str, Any],
) -> int:
    """Calibrate captures side by side; returns 1 if any of them has no answer to be trusted.

    Raises
    ------
    DataError
        Two captures would write the same file, or no cluster answers.
    """
    if output is not None:
        raise click.UsageError("-o names one file; of several captures each result goes beside its")
    if page is not None and page.name != str(page):
        raise click.UsageError(
            f"--report {page}: of several captures each page goes beside its; give a name only"
        )
    folders = [(path if path.is_dir() else path.parent).resolve() for path in captures]
    twice = [str(captures[i]) for i, folder in enumerate(folders) if folder in folders[:i]]
    if twice:
        raise DataError(
            f"{twice[0]}: another capture of the same folder is given before it, and both would "
            "write the same calibration.json; give it once, or calibrate them one by one with -o"
        )

    from lasercal_gtsam.engine import Work, run_all, workers_for

    jobs = None if cluster is not None else jobs
    workers = workers_for(jobs, cluster)
    spec = {
        "captures": [str(path.absolute()) for path in captures],
        "pages": [None if page is None else str(folder / page) for folder in folders],
    }
    work = Work("calibrate", partial(_run, settings), spec, len(captures))
    with progress("Captures", seldom=True) as show:
        results = run_all(work, workers, chunk_seconds=0.0, progress=lambda p: show(p.done, p.runs))
    found = [{"capture": str(c), **r} for c, r in zip(captures, results.values, strict=True)]
    if as_json:
        print_json({"captures": found})
    else:
        click.echo("\n".join(_lines(found)))
    for one in found:
        for message in one["messages"]:
            click.echo(f"{one['capture']}: {message}", err=True)
    if results.deaths:
        warn([f"workers died {results.deaths} times; their captures were calibrated again"])
    return max(int(one["status"]) for one in found)


def _run(settings: Mapping[str, Any], spec: Mapping[str, Any], k: int) -> dict[str, Any]:
    """Calibrate capture ``k``; its words are kept apart from those of the others."""
    from lasercal_gtsam.cli.calibrate import calibrate_one

    page = spec["pages"][k]
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = calibrate_one(
                Path(spec["captures"][k]),
                None,
                None if page is None else Path(page),
                True,
                **settings,
            )
        except (LasercalError, OSError) as error:
            status = 1
            for line in str(error).splitlines():
                click.echo(f"Error: {line}", err=True)
    document = json.loads(out.getvalue()) if out.getvalue() else {}
    return {
        "status": status,
        "saved": document.get("run", {}).get("saved"),
        "fit": document.get("fit"),
        "messages": err.getvalue().splitlines(),
    }


def _lines(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table, one line for each capture."""
    from lasercal_gtsam.calibration import text_table

    rows: list[tuple[str, ...]] = [("capture", "spots", "rejected", "RMS px", "result")]
    for one in found:
        fit = one["fit"]
        result = "saved" if one["saved"] else "nothing saved"
        if one["status"]:
            result += ", see below"
        numbers = ("", "", "")
        if fit is not None:
            numbers = (str(fit["n_spots"]), str(fit["n_rejected"]), f"{fit['rms_px']:.3f}")
        rows.append((one["capture"], *numbers, result))
    good = sum(one["status"] == 0 for one in found)
    rows.append((f"{good} of {len(found)} calibrated", "", "", "", ""))
    return text_table(rows).splitlines()
