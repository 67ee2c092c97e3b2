"""`lasercal calibrate`: a capture in, the table on the screen and ``calibration.json`` out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import json_option, print_json, progress, warn
from lasercal_gtsam.cli.given_lens import GivenLens, intrinsics_options
from lasercal_gtsam.cli.outputs import check_calibration_target
from lasercal_gtsam.cli.report import report_target
from lasercal_gtsam.cli.report import write as write_report
from lasercal_gtsam.cli.texts import account_lines, count, looked_at, result_lines
from lasercal_gtsam.cli.values import Assignment, Distortion, Number
from lasercal_gtsam.errors import DataError, DegenerateError, SolveError
from lasercal_gtsam.options import HAND_NOISE_NAMES

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.spot_account import SpotAccount

CALIBRATION_FILE = "calibration.json"


@click.command(
    short_help="Estimate the cell of a capture and save it with its sigmas.",
    epilog="Exit status: 0 saved; 1 wrong data, or an answer that cannot be trusted.",
)
@click.argument("captures", metavar="CAPTURE...", type=click.Path(path_type=Path), nargs=-1)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help=f"Where the result goes.  [default: {CALIBRATION_FILE} beside the capture]",
)
@click.option(
    "--initial",
    metavar="CELL.json",
    type=click.Path(path_type=Path),
    help="Start from this cell (drawings, or an earlier calibration.json) instead of from the "
    "data alone.",
)
@click.option(
    "--distortion",
    type=Distortion(),
    metavar="all|none|auto|k1,k2",
    default="all",
    show_default=True,
    help="Terms of the lens distortion to estimate, out of k1, k2, p1, p2; auto: those that the "
    "spots can carry.",
)
@click.option(
    "--known",
    type=Assignment(),
    metavar="NAME=VALUE",
    multiple=True,
    help="Hold at this value: principal_point=320,240, skew=0, aspect=1, fu, fv, u0, v0, k1, ... "
    "Repeatable; wins over capture.yaml.",
)
@click.option(
    "--fixed",
    metavar="NAME",
    multiple=True,
    help="Hold at the start's value: an intrinsic, intrinsics, T_base_camera, camera:NAME, "
    "laser:NAME or plane:NAME. Repeatable; mostly used with --initial.",
)
@click.option(
    "--robust",
    type=click.Choice(["auto", "none", "huber", "cauchy", "geman-mcclure", "gnc-tls"]),
    default="auto",
    show_default=True,
    help="What is done about outliers. auto and gnc-tls (graduated truncated least squares) name "
    "them and leave them out; huber, cauchy and geman-mcclure weigh every spot by that loss; none "
    "is plain least squares.",
)
@click.option(
    "--sigma-px",
    metavar="X",
    type=click.FloatRange(min=1e-9, max=1e6),
    help="Sigma of pixels that have none of their own; wins over capture.yaml.",
)
@click.option(
    "--estimate-noise",
    is_flag=True,
    help="Estimate the noise of the hand poses from the residuals, whatever capture.yaml states, "
    "and that of the pixels where none is stated.",
)
@click.option(
    "--keep-unconverged",
    is_flag=True,
    help="Save also an answer that cannot be trusted (the exit status stays 1).",
)
@click.option(
    "--report",
    "page",
    metavar="PATH",
    type=click.Path(path_type=Path),
    help="Also write the uncertainty report, one HTML file; see 'lasercal report'.",
)
@intrinsics_options
@click.option(
    "-j",
    "--jobs",
    metavar="N",
    type=click.IntRange(min=1),
    help="Several captures: so many at a time, each in its process.  [default: one for each core]",
)
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Several captures: on the Dask scheduler there, whose workers see the same files.",
)
@json_option
def calibrate(
    captures: tuple[Path, ...],
    output: Path | None,
    page: Path | None,
    as_json: bool,
    jobs: int | None,
    cluster: str | None,
    **settings: Any,
) -> int:
    """Calibrate the cell of each CAPTURE (capture.yaml, or its folder) and save the result.

    Prints the parameters with their sigmas, what was held, what was rejected and why. Spots without
    pixels are looked for in their pictures. Of several captures each result goes beside its
    capture, and a line is printed for each.
    """
    if not captures:
        raise click.UsageError("Missing argument 'CAPTURE...'.")
    if len(captures) > 1:
        from lasercal_gtsam.cli.fleet import calibrate_many

        return calibrate_many(captures, output, page, as_json, jobs, cluster, settings)
    if jobs is not None or cluster is not None:
        raise click.UsageError("--jobs and --cluster are for several captures; this is one")
    return calibrate_one(captures[0], output, page, as_json, **settings)


def calibrate_one(
    capture: Path,
    output: Path | None,
    page: Path | None,
    as_json: bool,
    *,
    initial: Path | None,
    distortion: str | tuple[str, ...],
    known: tuple[tuple[str, Number], ...],
    fixed: tuple[str, ...],
    robust: str,
    sigma_px: float | None,
    estimate_noise: bool,
    keep_unconverged: bool,
    lens: GivenLens,
) -> int:
    """One capture, with the options of the command; returns the exit status."""
    from lasercal_gtsam.io.capture import load_capture

    loaded = load_capture(capture)
    warn(loaded.warnings)
    target = _target(output, loaded.path)
    page = None if page is None else report_target(page, loaded.path.parent)
    start = _start(initial)
    with progress("Looking at pictures") as show:
        account = loaded.detections(progress=show)
    warn(account.notes)
    observations = loaded.observations(account=account)
    given: dict[str, Any] = {} if sigma_px is None else {"sigma_px": sigma_px}
    if estimate_noise:
        given |= {"estimate_noise": HAND_NOISE_NAMES, **dict.fromkeys(HAND_NOISE_NAMES, 0.0)}
    options = loaded.options(
        distortion=distortion, robust=robust, fixed=fixed, known=dict(known), **given
    )
    options, start = lens.apply(observations, options, start, dict(known))

    from lasercal_gtsam.api import calibrate as solve

    hint = f"'lasercal check {capture}' looks for the cause"
    try:
        result = solve(observations, initial=start, options=options)
    except (DegenerateError, SolveError) as error:
        raise type(error)(f"{error}; {hint}") from error
    saved, failure = None, None
    if result.fit.converged or keep_unconverged:
        try:
            save(result, target, loaded)
            saved = target
        except DataError as error:  # a full disk must not cost the answer
            failure = error
    if page is not None:  # of an answer that cannot be trusted too: it says why
        save_report(result, page, loaded, account, saved)
    if as_json:
        print_json(_document(result, loaded, account, saved))
    else:
        click.echo("\n".join(_report(result, loaded, account)))
        for path in filter(None, (saved, page)):
            click.echo(f"Saved {path}.")
    if failure is not None:
        raise failure
    if _fits_badly(result):
        click.echo(
            f"Warning: the residuals are as large as if something were wrong; {hint}", err=True
        )
    if result.fit.converged:
        return 0
    outcome = "saved all the same" if saved else "nothing was saved (see --keep-unconverged)"
    click.echo(f"Error: {result.fit.status}; {outcome}; {hint}", err=True)
    return 1


def _fits_badly(result: Calibration) -> bool:
    """Residuals of more than 1 % of the image diagonal: no detector is as bad as that."""
    import numpy as np

    diagonal = max(np.hypot(*size) for size in result.inputs.observations.image_size.values())
    return bool(result.fit.rms_px > 0.01 * diagonal)


def save(result: Calibration, path: Path, capture: Capture) -> None:
    """Write ``calibration.json`` with the digests of the files it comes from."""
    from lasercal_gtsam.io.calibration_file import save_calibration

    save_calibration(result, path, sources=capture.provenance)


def save_report(
    result: Calibration, page: Path, capture: Capture, account: SpotAccount, saved: Path | None
) -> None:
    """Write the report, with pictures of what was left out."""
    from lasercal_gtsam.report.material import Origin

    origin = Origin(files=capture.provenance) if saved is None else Origin.of_file(saved)
    write_report(result, page, origin, capture, account)


def _target(output: Path | None, capture: Path) -> Path:
    target = capture.parent / CALIBRATION_FILE if output is None else output
    if target.is_dir():
        target = target / CALIBRATION_FILE
    check_calibration_target(target)
    return target


def _start(path: Path | None) -> Cell | None:
    if path is None:
        return None
    from lasercal_gtsam.io.cell_file import load_cell

    return load_cell(path)


def _report(result: Calibration, capture: Capture, account: SpotAccount) -> list[str]:
    seen = result.inputs.observations
    lines = [
        f"{capture.path}: {count(len(seen), 'spot')} on {count(len(seen.planes), 'plane')} "
        f"({', '.join(seen.planes)})"
    ]
    if pictures := looked_at(account):
        lines.append(f"{count(pictures, 'picture')} looked at")
    see = f"'lasercal detect {capture.path.parent}' draws them"
    if skipped := account_lines(account, see):
        lines += [f"{count(len(account.skipped), 'row')} without a usable spot:", *skipped]
        lines += [f"  {see}"] if pictures else []
    return [*lines, "", *result_lines(result)]


def _document(
    result: Calibration, capture: Capture, account: SpotAccount, saved: Path | None
) -> dict[str, Any]:
    """Build what ``calibration.json`` holds, and what only the run itself knows."""
    from lasercal_gtsam.io.calibration_file import to_dict

    return {
        **to_dict(result, sources=capture.provenance),
        "run": {
            "capture": str(capture.path),
            "saved": None if saved is None else str(saved),
            "pictures": looked_at(account),
            "verdicts": account.counts,
            "skipped": account.skipped,
            "warnings": [*capture.warnings, *account.notes],
        },
    }
