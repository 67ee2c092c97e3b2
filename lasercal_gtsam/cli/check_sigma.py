"""`lasercal check-sigma`: whether the sigmas of a calibration hold on its own geometry."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import (
    bullets,
    json_option,
    print_json,
    progress,
    seed_option,
    wrapped,
)
from lasercal_gtsam.cli.outputs import check_target
from lasercal_gtsam.cli.texts import count

if TYPE_CHECKING:
    from lasercal_gtsam.sigma_check.result import Coverage, RowCheck, SigmaCheck

FORMAT, VERSION = "lasercal-sigma-check", 1


@click.command(
    name="check-sigma",
    short_help="Check a calibration's sigmas by simulation.",
    epilog="Exit status: 0 the sigmas hold; 1 they do not, or wrong data.",
)
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option(
    "--trials",
    metavar="N",
    type=click.IntRange(min=20),
    default=200,
    show_default=True,
    help="How often to simulate and solve. With N trials a spread is known to 1/sqrt(2N).",
)
@seed_option("Of the simulated noise; the same seed gives the same numbers.")
@click.option(
    "--from-data",
    is_flag=True,
    help="Solve every trial from its data alone instead of from the estimate. Slower; shows also "
    "whether a start leads elsewhere.",
)
@click.option(
    "-o",
    "--output",
    metavar="FILE.json",
    type=click.Path(path_type=Path),
    help="Write the result there, too, as one JSON document.",
)
@json_option
def check_sigma(
    calibration: Path,
    trials: int,
    seed: int,
    from_data: bool,
    output: Path | None,
    as_json: bool,
) -> int:
    """Simulate the cell of CALIBRATION (calibration.json) again and again, and solve it anew.

    Its estimate is the truth, its hand poses are the geometry, its noise is the noise. Prints for
    each parameter the sigma stated and the spread found, how often the intervals held the truth,
    and whether the sigmas hold. It cannot tell whether the noise is what it is taken for: for that
    look at the residuals.
    """
    from lasercal_gtsam.io.calibration_file import load_calibration

    if output is not None:
        check_target(output, FORMAT, "a result of check-sigma")
    loaded = load_calibration(calibration)

    from lasercal_gtsam.sigma_check.study import check_sigma as study

    with progress("Trials") as show:
        found = study(loaded, trials=trials, seed=seed, from_data=from_data, progress=show)
    document = _document(calibration, found)
    if output is not None:
        _write(document, output)
    if as_json:
        print_json(document)
    else:
        click.echo("\n".join(_report(calibration, found)))
        if output is not None:
            click.echo(f"Saved {output}.")
    for problem in found.problems:
        click.echo(f"Error: {problem}", err=True)
    return 0 if found.holds else 1


def _report(path: Path, found: SigmaCheck) -> list[str]:
    nees = found.nees
    start = "from the data alone" if found.from_data else "from the estimate"
    left_out = f" ({found.left_out} rejected ones left out)" if found.left_out else ""
    lines = [
        wrapped(
            f"{path}: {count(found.spots, 'spot')}{left_out}; {found.trials} trials with new noise "
            f"of {found.noise_px:.3g} px, each solved {start} (seed {found.seed})."
        ),
        "",
        sigma_table(found),
        "",
        wrapped(
            "ratio: spread of the estimates over the sigma stated; 68 %, 95 %: how many of the "
            "stated intervals held the truth; own: of the 95 % intervals that each trial states "
            "itself; bias: mean error in sigmas."
        ),
        wrapped(
            f"Normalised squared error of all {nees.dimension} unknowns together (NEES): "
            f"{nees.mean:.2f} on the average, 99 % band {nees.low:.2f} to {nees.high:.2f}."
        ),
    ]
    if found.rejected:
        lines.append(wrapped(f"Rejected as outliers in all trials: {found.rejected} spots."))
    if found.notes:
        lines += ["Remarks:", *bullets(found.notes)]
    if found.problems:
        return [*lines, "", wrapped("The sigmas do not all hold; see the errors.")]
    return [*lines, "", wrapped(found.verdict)]


def sigma_table(found: SigmaCheck) -> str:
    """Text table: a line for each estimated row, what is promised last."""
    from lasercal_gtsam.calibration import text_table

    lines: list[tuple[str, ...]] = [
        ("", "sigma", "spread", "ratio", "68 %", "95 %", "own", "bias", "Unit")
    ]
    lines += [_line(row) for row in found.rows]
    lines.append(("promised", "", "", "1.00", "68.3", "95.0", "95.0", "0.00", ""))
    chance = 1 / math.sqrt(found.solved)
    shares = [100 * chance * math.sqrt(p * (1 - p)) for p in (0.683, 0.95, 0.95)]
    by_chance = (f"{chance / math.sqrt(2):.2f}", *(f"{s:.1f}" for s in shares), f"{chance:.2f}")
    lines.append(("chance, +-", "", "", *by_chance, ""))
    return text_table(lines)


def _line(row: RowCheck) -> tuple[str, ...]:
    decimals = min(max(1 - math.floor(math.log10(row.sigma)), 0), 9)
    return (
        row.name,
        f"{row.sigma:.{decimals}f}",
        f"{row.scatter:.{decimals}f}",
        f"{row.ratio:.2f}",
        _share(row.coverage_68),
        _share(row.coverage_95),
        _share(row.own_coverage_95),
        f"{round(row.bias, 2) + 0.0:.2f}",
        row.unit,
    )


def _share(found: Coverage) -> str:
    return f"{100 * found.share:.1f}"


def _document(path: Path, found: SigmaCheck) -> dict[str, Any]:
    from lasercal_gtsam.io.plain import plain

    return {
        "format": FORMAT,
        "version": VERSION,
        "calibration": str(path),
        **plain(found),
    }


def _write(document: dict[str, Any], path: Path) -> None:
    from lasercal_gtsam.io.files import write_text
    from lasercal_gtsam.io.plain import to_json

    write_text(path, to_json(document) + "\n")
