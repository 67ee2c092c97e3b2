"""`lasercal demo`: the whole way on simulated pictures, and the answer beside the truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lasercal_gtsam.cli.calibrate import CALIBRATION_FILE, save, save_report
from lasercal_gtsam.cli.console import json_option, print_json, progress, seed_option, wrapped
from lasercal_gtsam.cli.detect import SHEET_FILE, SPOTS_FILE, find_spots, save_sheet, save_spots
from lasercal_gtsam.cli.outputs import capture_folder
from lasercal_gtsam.cli.report import REPORT_FILE
from lasercal_gtsam.cli.texts import account_lines, count, looked_at, result_lines
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lasercal_gtsam.calibration import Calibration, Parameter
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.spot_account import SpotAccount

PRESET = "paper-distorted"
# what a good industrial robot repeats to, sigma of each coordinate
HAND_MM, HAND_DEG = 0.05, 0.005

_CONTENTS = {
    "capture.yaml": "camera, pose convention, where the pictures are, noise",
    "poses.csv": "the hand poses, as a controller reports them",
    "images/": "the pictures, laser on and laser off",
    SPOTS_FILE: "what was found in each picture, or why nothing was",
    SHEET_FILE: "every spot enlarged, to be looked at",
    CALIBRATION_FILE: "the result with everything that made it",
    REPORT_FILE: "the uncertainty report: open it in a browser",
    "truth.json": "the cell that the pictures were made of",
}


@click.command(short_help="The whole way on simulated pictures, beside the truth.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("lasercal-demo"),
    show_default=True,
    help="The folder for everything that is made; an earlier demo there is replaced.",
)
@seed_option("Another seed is another robot cell, with other pictures.", default=1)
@click.option("--force", is_flag=True, help="Use OUT also where other files are in it.")
@json_option
def demo(out: Path, seed: int, force: bool, as_json: bool) -> int:
    """Simulate pictures of a laser spot, detect the spots, calibrate, compare with the truth.

    Takes some seconds. What is left in OUT is what a real calibration looks like, to be copied.
    """
    from lasercal_gtsam.api import calibrate
    from lasercal_gtsam.io.capture import load_capture
    from lasercal_gtsam.simulate import load_truth

    _take_pictures(out, seed, force)
    capture = load_capture(out)
    with progress("Looking at pictures") as show:
        account = find_spots(capture, {}, show)
    save_spots(account, out / SPOTS_FILE)
    save_sheet(capture, account, out / SHEET_FILE)
    observations = capture.observations(account=account)
    result = calibrate(observations, options=capture.options())
    save(result, out / CALIBRATION_FILE, capture)
    save_report(result, out / REPORT_FILE, capture, account, out / CALIBRATION_FILE)
    rows = compare(result, load_truth(out))
    if as_json:
        print_json(_document(out, seed, result, rows, account))
    else:
        click.echo("\n".join(_report(out, capture, account, result, rows)))
    if result.fit.converged:
        return 0
    click.echo(f"Error: {result.fit.status}", err=True)
    return 1


class Comparison(NamedTuple):
    """One row of the table beside the truth, in its unit; ``sigmas`` is NaN for a held row."""

    parameter: Parameter
    truth: float
    sigmas: float


def compare(result: Calibration, truth: Cell) -> list[Comparison]:
    """Every row of the table with its true value and ``(refined - truth) / sigma``.

    The truth is written in the result's parameterisation of the beam; angles are compared on the
    circle.
    """
    from lasercal_gtsam.report_map import BeamChart, row_names, row_values

    charts = {name: BeamChart.of(result.cell.lasers[name]) for name in truth.lasers}
    names = [name for name, _ in row_names(truth, charts)]
    true = dict(zip(names, row_values(truth, charts).tolist(), strict=True))
    rows = []
    for parameter in result.parameters:
        error = parameter.refined - true[parameter.name]
        if parameter.unit == "deg":
            error = (error + 180.0) % 360.0 - 180.0
        sigmas = error / parameter.sigma if parameter.sigma > 0 else math.nan
        rows.append(Comparison(parameter, true[parameter.name], sigmas))
    return rows


def truth_table(result: Calibration, rows: Sequence[Comparison]) -> str:
    """Table 2's text with two more columns: the truth, and the error in sigmas."""
    from lasercal_gtsam.calibration import plain_number, table_decimals, table_row, text_table

    lines: list[tuple[str, ...]] = [
        ("", "Initial", "Refined", "sigma", "Truth", "Error/sigma", "Unit")
    ]
    for parameter, truth, sigmas in rows:
        *cells, unit = table_row(parameter)
        true = plain_number(truth, table_decimals(parameter))
        lines.append((*cells, true, _signed(sigmas), unit))
    lines.append(("RMS", "", f"{result.fit.rms_px:.4g}", "", "", "", "px"))
    return text_table(lines)


def _signed(sigmas: float) -> str:
    return f"{round(sigmas, 1) + 0.0:+.1f}" if math.isfinite(sigmas) else ""


def _take_pictures(out: Path, seed: int, force: bool) -> None:
    from lasercal_gtsam.simulate import Noise, simulate, write_simulation
    from lasercal_gtsam.simulate.pictures import PictureOptions
    from lasercal_gtsam.simulate.write import TRUTH_FILE

    # only simulations have a truth, so nobody's pictures are lost
    earlier = (out / TRUTH_FILE).is_file()
    with capture_folder(out, force or earlier) as folder, progress("Taking pictures") as show:
        noise = Noise(0.0, HAND_MM * M_PER_MM, HAND_DEG * RAD_PER_DEG)
        made = simulate(PRESET, seed, noise)
        write_simulation(folder, made, spots=False, pictures=PictureOptions(), progress=show)
    for name in (CALIBRATION_FILE, REPORT_FILE, SPOTS_FILE, SHEET_FILE):  # of an earlier demo
        (out / name).unlink(missing_ok=True)


def _report(
    out: Path,
    capture: Capture,
    account: SpotAccount,
    result: Calibration,
    rows: Sequence[Comparison],
) -> list[str]:
    planes = len(set(capture.planes.tolist()))
    skipped = account_lines(account, f"all are in {out / SPOTS_FILE}")
    usable = sum(account.usable)
    return [
        wrapped(
            f"Simulated: {len(capture)} hand poses on {planes} planes, each with a picture with "
            "the laser on and one with it off. The hand repeats to "
            f"{HAND_MM:g} mm and {HAND_DEG:g} deg."
        ),
        wrapped(
            f"Detected: {usable} of {count(looked_at(account), 'picture')} gave a spot"
            + ("; the others were refused:" if skipped else ".")
        ),
        *skipped,
        "Calibrated from the pictures and the hand poses alone; the truth for comparison:",
        "",
        *result_lines(result, truth_table(result, rows)),
        "",
        wrapped(_verdict(rows)),
        "",
        f"Everything is in {out}:",
        *(f"  {name:<18} {what}" for name, what in _CONTENTS.items()),
        wrapped(
            f"Next: look at {REPORT_FILE} and {SHEET_FILE}. 'lasercal calibrate {out}' does the "
            "last two steps from the folder; for your own pictures and hand poses write a "
            "capture.yaml like this one."
        ),
    ]


def _verdict(rows: Sequence[Comparison]) -> str:
    """How far the estimate is from the truth, against what honest sigmas promise."""
    lengths = [abs(row.sigmas) for row in rows if math.isfinite(row.sigmas)]
    if not lengths:
        return "No sigmas, so nothing to compare with the truth."
    within = [sum(length <= k for length in lengths) for k in (1, 2, 3)]
    far = max((row for row in rows if math.isfinite(row.sigmas)), key=lambda row: abs(row.sigmas))
    return (
        f"Of {len(lengths)} estimated values {within[0]} lie within 1 sigma of the truth, "
        f"{within[1]} within 2 and {within[2]} within 3 (honest sigmas promise 68 %, 95 % and "
        f"99.7 %); the farthest is {far.parameter.name}, {abs(far.sigmas):.1f} sigma away."
    )


def _document(
    out: Path,
    seed: int,
    result: Calibration,
    rows: Sequence[Comparison],
    account: SpotAccount,
) -> dict[str, Any]:
    return {
        "out": str(out),
        "preset": PRESET,
        "seed": seed,
        "fit": result.fit,
        "verdicts": account.counts,
        "skipped": account.skipped,
        "parameters": [
            {
                "name": row.parameter.name,
                "initial": row.parameter.initial,
                "refined": row.parameter.refined,
                "sigma": row.parameter.sigma,
                "truth": row.truth,
                "error_in_sigmas": row.sigmas,
                "unit": row.parameter.unit,
            }
            for row in rows
        ],
    }
