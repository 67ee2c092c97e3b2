"""`lasercal study`: the paper's experiments, or the same for one's own cell."""

from __future__ import annotations

import csv
import io
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import (
    F,
    json_option,
    print_json,
    progress,
    seed_option,
    warn,
    wrapped,
)
from lasercal_gtsam.cli.values import Names, Numbers
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.engine import Workers
    from lasercal_gtsam.study import Study


_FAMILIES = ("M1", "M2", "M3", "M4")


def _shared(trials: int) -> Callable[[F], F]:
    """Options of every study."""
    options = (
        click.option(
            "-o",
            "--output",
            metavar="FOLDER",
            type=click.Path(path_type=Path, file_okay=False),
            help="Where table, CSV, JSON, figures (PNG, SVG) and page go, and the journal of "
            "finished runs: the same command goes on after an interruption.",
        ),
        click.option(
            "--trials",
            metavar="N",
            type=click.IntRange(min=1),
            default=trials,
            show_default=True,
            help="How often each point is simulated and solved.",
        ),
        seed_option("The same seed gives the same numbers, whatever runs them."),
        click.option(
            "-j",
            "--jobs",
            metavar="N",
            type=click.IntRange(min=1),
            help="Processes on this machine.  [default: one for each core]",
        ),
        click.option(
            "--cluster",
            metavar="ADDRESS",
            help="Run on the Dask scheduler there, such as tcp://host:8786, instead.",
        ),
        json_option,
    )

    def decorate(function: F) -> F:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


def _cell_options(function: F) -> F:
    for option in reversed(
        (
            click.option(
                "--cell",
                metavar="CELL",
                type=click.Path(path_type=Path),
                help="Simulate this cell instead of the paper's: a calibration.json, a cell from "
                "drawings, or a capture, which is calibrated first.",
            ),
            click.option(
                "--design",
                metavar="NAME",
                help="How the hand moves: paper, near, mid, far, near-narrow, table, arbitrary.",
            ),
        )
    ):
        function = option(function)
    return function


@click.group(short_help="Run the paper's experiments, there or in your own cell.")
def study() -> None:
    """Simulate and solve many times: the paper's Fig. 6, Fig. 7 and Table 2.

    Each prints its numbers and what agrees with the paper; -o writes files and a page.
    """


@study.command(short_help="Errors of four methods against the noise.")
@_shared(200)
@_cell_options
@click.option(
    "--levels",
    type=Numbers(),
    metavar="A,B,...",
    default="0,0.2,0.4,0.6,0.8,1",
    show_default=True,
    help="Noise, in multiples of 1 px, 1 mm and 0.05 deg.",
)
@click.option(
    "--planes", type=Names(), metavar="A,B,...", help="Names of the planes to use.  [default: all]"
)
@click.option(
    "--groups",
    metavar="N",
    type=click.IntRange(min=1),
    help="Hand orientations on each plane.  [default: 3]",
)
@click.option(
    "--shots",
    metavar="N",
    type=click.IntRange(min=1),
    help="Spots in each orientation.  [default: 10]",
)
@click.option(
    "--methods",
    type=Names(*_FAMILIES),
    default=",".join(_FAMILIES),
    metavar="M1,M2,...",
    help="Families to compare, out of M1 (laser), M2 (Ma), M3 (Malm & Heyden), M4 (Horaud & "
    "Dornaika).",
    show_default=True,
)
def fig6(
    output: Path | None,
    trials: int,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    as_json: bool,
    cell: Path | None,
    design: str | None,
    levels: tuple[float, ...],
    planes: tuple[str, ...] | None,
    groups: int | None,
    shots: int | None,
    methods: tuple[str, ...],
) -> None:
    """Relative errors of f_u, R and T for the laser method (M1) and those it is compared with.

    Closed form and refined; and the laser method with the robot's noise modelled.
    """
    from lasercal_gtsam.study import fig6 as run
    from lasercal_gtsam.study.cells import StudyCell
    from lasercal_gtsam.study.fig6_runs import METHODS

    chosen = StudyCell(
        cell=_cell(cell),
        planes=planes,
        groups=groups,
        shots=shots,
        design=design,
    )
    settings = {
        "trials": trials,
        "levels": levels,
        "cell": chosen,
        "methods": [m for m in METHODS if m[:2] in methods],
        "seed": seed,
    }
    _finish(_run(run, settings, "fig6", jobs, cluster, output), output, as_json)


@study.command(short_help="Error of f_u against the number of samples.")
@_shared(150)
@_cell_options
@click.option(
    "--samples",
    type=Numbers(),
    metavar="A,B,...",
    default="30,60,120,180,240,300",
    show_default=True,
    help="Spots on all planes together, ten in each hand orientation.",
)
@click.option(
    "--sigma-px",
    metavar="X",
    type=click.FloatRange(min=0),
    default=1.0,
    show_default=True,
    help="Pixel noise.",
)
def fig7(
    output: Path | None,
    trials: int,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    as_json: bool,
    cell: Path | None,
    design: str | None,
    samples: tuple[float, ...],
    sigma_px: float,
) -> None:
    """Error of the focal length on one, two and three planes, closed form and refined.

    With --cell: on each of its planes alone, and on all of them.
    """
    from lasercal_gtsam.study import fig7 as run
    from lasercal_gtsam.study.cells import StudyCell
    from lasercal_gtsam.study.fig7_runs import CASES

    own = _cell(cell)
    if own is None:
        cases = {
            name: StudyCell(c.preset, None, c.planes, design=design) for name, c in CASES.items()
        }
    else:
        cases = {f"plane {p}": StudyCell(cell=own, planes=(p,), design=design) for p in own.planes}
        if len(own.planes) > 1:
            cases[f"{len(own.planes)} planes"] = StudyCell(cell=own, design=design)
    if any(n != int(n) for n in samples):
        raise click.UsageError(f"--samples: expected whole numbers, got {samples}")
    settings = {
        "trials": trials,
        "samples": [int(n) for n in samples],
        "cases": cases,
        "pixel_px": sigma_px,
        "seed": seed,
    }
    _finish(_run(run, settings, "fig7", jobs, cluster, output), output, as_json)


@study.command(short_help="The four tests: initial, refined, sigma.")
@_shared(60)
@click.option(
    "--tests",
    type=Names("1", "2", "3", "4"),
    metavar="1,2,...",
    default="1,2,3,4",
    show_default=True,
    help="Which of the paper's tests.",
)
@click.option(
    "--design",
    metavar="NAME",
    help="How the hand moves: near, mid, far, near-narrow.  [default: far]",
)
def table2(
    output: Path | None,
    trials: int,
    seed: int,
    jobs: int | None,
    cluster: str | None,
    as_json: bool,
    tests: tuple[str, ...],
    design: str | None,
) -> None:
    """Estimates and sigmas of simulated cells of the kind of Table 2, beside the printed sigmas."""
    from lasercal_gtsam.study import table2 as run

    settings = {
        "trials": trials,
        "tests": [f"Test {t}" for t in tests],
        "design": design,
        "seed": seed,
    }
    _finish(_run(run, settings, "table2", jobs, cluster, output), output, as_json)


def _run(
    function: Callable[..., Study],
    settings: dict[str, Any],
    name: str,
    jobs: int | None,
    cluster: str | None,
    output: Path | None,
) -> Study:
    from lasercal_gtsam.engine import workers_for

    workers: Workers = workers_for(jobs, cluster)
    journal = None
    if output is not None:
        try:
            output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{output}: cannot be a folder of results: {error.strerror}") from None
        journal = output / f"{name}.journal"
    try:
        with progress("Runs", seldom=True) as show:
            found = function(
                **settings,
                workers=workers,
                journal=journal,
                progress=lambda p: show(p.done, p.runs),
            )
    except KeyboardInterrupt:
        if journal is not None:
            click.echo(
                f"The runs finished so far are in {journal}: the same command goes on.", err=True
            )
        raise
    notes = []
    if found.results.resumed:
        notes.append(f"{found.results.resumed} runs were in {journal} already")
    if found.results.deaths:
        notes.append(f"workers died {found.results.deaths} times; their runs were run again")
    warn(notes)
    return found


def _finish(found: Study, output: Path | None, as_json: bool) -> None:
    if as_json:
        print_json(found.to_dict())
    else:
        lines = [found.table(), "", "What agrees with the paper:"]
        for f in found.findings:
            word = {True: "yes", False: "NO ", None: "?  "}[f.holds]
            lines.append(wrapped(f"{word}  {f.claim}: {f.evidence}", "  ", "       "))
        click.echo("\n".join(lines))
    if output is not None:
        written = write_study(found, output, "lasercal " + shlex.join(sys.argv[1:]))
        if not as_json:
            click.echo(f"Saved {', '.join(p.name for p in written)} in {output}.")


def write_study(found: Study, folder: Path, command: str) -> list[Path]:
    """Write text, CSV, JSON, figures and page; returns the paths."""
    from lasercal_gtsam.io.files import write_bytes, write_text
    from lasercal_gtsam.io.plain import to_json
    from lasercal_gtsam.study.page import page_of

    base = folder / found.name
    written = []

    def text(ending: str, content: str) -> None:
        path = base.with_suffix(ending)
        write_text(path, content)
        written.append(path)

    text(".txt", found.table() + "\n")
    text(".json", to_json(found.to_dict()) + "\n")
    if records := _records(found):
        sheet = io.StringIO()
        writer = csv.DictWriter(sheet, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
        text(".csv", sheet.getvalue())
    svg = None
    try:
        from lasercal_gtsam.study.plots import as_bytes, figure_of

        figure = figure_of(found)
    except DataError as error:
        warn([f"no figures: {error}"])
    else:
        svg = as_bytes(figure, "svg").decode()
        text(".svg", svg)
        write_bytes(base.with_suffix(".png"), as_bytes(figure, "png"))
        written.append(base.with_suffix(".png"))
    text(".html", page_of(found, command, svg))
    return written


def _records(found: Study) -> list[dict[str, Any]]:
    records = [r for c in found.curves.values() for r in c.records()]
    for c in found.columns:
        records += [
            {
                "test": c.name,
                "parameter": name,
                "truth": c.truth[i],
                "initial": c.initial[i],
                "refined": c.refined[i],
                "sigma": c.sigma[i],
                "median_sigma": c.median_sigma[i],
                "spread": c.spread[i],
                "printed_sigma": c.printed[i],
            }
            for i, name in enumerate(c.names)
        ]
    return records


def _cell(path: Path | None) -> Cell | None:
    """A cell from its file, or of a capture that is calibrated for it."""
    if path is None:
        return None
    if path.is_dir() or path.suffix in (".yaml", ".yml"):
        from lasercal_gtsam.api import calibrate
        from lasercal_gtsam.io.capture import load_capture

        capture = load_capture(path)
        return calibrate(capture.observations(), options=capture.options()).cell
    from lasercal_gtsam.io.cell_file import load_cell

    return load_cell(path)
