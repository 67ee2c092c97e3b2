"""`lasercal report`: the uncertainty report of a calibration as one page that needs no network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import json_option, print_json, progress, warn
from lasercal_gtsam.cli.outputs import check_target, check_writable
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.spot_account import SpotAccount
    from lasercal_gtsam.report.material import Origin
    from lasercal_gtsam.report.table import Intervals

REPORT_FILE = "report.html"
_PAGE = b"<!doctype html"


@click.command(
    short_help="Write the uncertainty report of a calibration.",
    epilog="Exit status: 0 written, whatever the verdict ('lasercal judge' has one for scripts); 1 "
    "not readable, or not writable.",
)
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help=f"Where the page goes.  [default: {REPORT_FILE} beside the calibration]",
)
@click.option(
    "--document",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Also write what the page shows as one JSON document.",
)
@click.option(
    "--capture",
    type=click.Path(path_type=Path),
    help="The capture it was made from, for pictures of spots that were left out.  [default: the "
    "one beside the calibration, if it has not changed since]",
)
@click.option(
    "--intervals",
    type=click.Choice(["sigma", "likelihood"]),
    default="sigma",
    show_default=True,
    help="Where the 95 % intervals come from: sigma, even about the answer; likelihood, right also "
    "where the problem bends (few spots, all distortion terms), some tenths of a second a row.",
)
@json_option
def report(
    calibration: Path,
    output: Path | None,
    document: Path | None,
    capture: Path | None,
    intervals: str,
    as_json: bool,
) -> int:
    """Write the report of CALIBRATION (calibration.json): one HTML file, to be read anywhere.

    The verdict and what to do next, parameters with intervals, what was left out, residuals,
    coverage, the expected error in millimetres on every plane, correlations, the cell in space, the
    conventions, and how to repeat the run.
    """
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.report.material import Origin

    target = report_target(output, calibration.parent)
    if document is not None:
        check_document_target(document)
    loaded = load_calibration(calibration)
    origin = Origin.of_file(calibration)
    found = _capture(capture, calibration.parent, origin)
    account = None if found is None else _account(found, loaded)
    ends = _by_likelihood(loaded) if intervals == "likelihood" else None
    made = write(loaded, target, origin, found, account, document, ends)
    if as_json:
        print_json(made)
        return 0
    click.echo(f"Saved {target}." if document is None else f"Saved {target} and {document}.")
    return 0


def write(
    calibration: Calibration,
    target: Path,
    origin: Origin,
    capture: Capture | None,
    account: SpotAccount | None,
    document: Path | None = None,
    intervals: Intervals | None = None,
) -> dict[str, Any]:
    """Write the page, and the document where that is wanted; returns the document."""
    from lasercal_gtsam.report.file import report as save

    return save(
        calibration,
        target,
        document=document,
        origin=origin,
        capture=capture,
        account=account,
        intervals=intervals,
    )


def _by_likelihood(calibration: Calibration) -> Intervals:
    """95 % intervals of all rows that were estimated; `DataError` where there can be none."""
    from lasercal_gtsam.confidence import intervals

    names = [p.name for p in calibration.parameters if p.sigma > 0]
    found: dict[str, tuple[float, float]] = {}
    with progress("Following the likelihood") as show:
        for done, name in enumerate(names, start=1):
            found |= intervals(calibration, [name])
            show(done, len(names))
    return found


def report_target(output: Path | None, folder: Path) -> Path:
    """Where the page goes; `DataError` where it cannot, or where something else is."""
    return page_target(folder / REPORT_FILE if output is None else output, REPORT_FILE)


def page_target(target: Path, name: str) -> Path:
    """The file, or one of that name where a folder was given; `DataError` as in `report_target`."""
    if target.is_dir():
        target = target / name
    check_writable(target)
    if target.exists() and not _is_page(target):
        raise DataError(
            f"{target}: there is a file that is not a page, and it is left as it is; give another "
            "name, or remove it"
        )
    return target


def check_document_target(path: Path) -> None:
    """Raise `DataError` where the document cannot be written, or something else is there."""
    from lasercal_gtsam.report.document import FORMAT

    check_target(path, FORMAT, "a lasercal report")


def _is_page(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            start = file.read(len(_PAGE))
    except OSError:
        return False
    return not start or start.lower() == _PAGE


def _capture(given: Path | None, folder: Path, origin: Origin) -> Capture | None:
    """The capture that the calibration was made from; None where it is not at hand."""
    from lasercal_gtsam.io.capture import CAPTURE_FILE, load_capture

    beside = folder / CAPTURE_FILE
    if given is None and not beside.is_file():
        return None
    try:
        found = load_capture(beside if given is None else given)
    except DataError as error:
        if given is not None:
            raise
        warn([f"{beside} cannot be read ({error}): no pictures in the report"])
        return None
    differ = _differences(found.provenance, origin.files)
    if differ and given is None:
        warn(
            [
                f"{beside} is not what the calibration was made from ({differ}): no pictures in "
                "the report; give it with --capture if it is right all the same"
            ]
        )
        return None
    if differ:
        warn([f"{found.path} is not what the calibration was made from ({differ})"])
    return found


def _differences(now: Any, then: Any) -> str:
    """Files that the calibration was not made from in their present form."""
    return ", ".join(
        f"{name} {'has changed' if name in then else 'was not part of it'}"
        for name, digest in now.items()
        if then.get(name) != digest
    )


def _account(capture: Capture, calibration: Calibration) -> SpotAccount | None:
    """What became of the capture's rows; pictures are looked at only if a row is missing."""
    known = set(calibration.inputs.observations.id.tolist())
    if known.issuperset(capture.ids.tolist()):
        return None
    with progress("Looking at pictures") as show:
        try:
            return capture.detections(progress=show)
        except DataError as error:
            warn([f"the pictures cannot be looked at again: {error}"])
            return None
