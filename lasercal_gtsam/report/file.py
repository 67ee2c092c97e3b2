"""The report as files: one self-contained page, and the dictionary that it is made of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.io.files import write_text
from lasercal_gtsam.io.plain import to_json
from lasercal_gtsam.report.document import make_document
from lasercal_gtsam.report.html import render
from lasercal_gtsam.report.material import Origin

if TYPE_CHECKING:
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.spot_account import SpotAccount
    from lasercal_gtsam.report.table import Intervals


def report(
    calibration: Calibration,
    path: str | Path,
    *,
    document: str | Path | None = None,
    origin: Origin | None = None,
    capture: Capture | None = None,
    account: SpotAccount | None = None,
    intervals: Intervals | None = None,
) -> dict[str, Any]:
    """Write the uncertainty report, one HTML file that needs no network.

    Parameters
    ----------
    calibration : the result to report on
    path : where the page goes; an old file stays until the new one is whole
    document : where the dictionary that it is made of goes, as JSON; None: nowhere
    origin : where the calibration came from, as far as known (`Origin.of_file`)
    capture, account : what it was made from, and what became of the capture's rows: for pictures of
        the spots that were left out
    intervals : 95 % intervals of the rows (`lasercal_gtsam.intervals`); None: those by sigma

    Returns
    -------
    dict
        What the page shows, as in the JSON document.

    Raises
    ------
    DataError
        A file cannot be written.
    """
    made = make_document(
        calibration, origin=origin, capture=capture, account=account, intervals=intervals
    )
    page = render(made)
    if document is not None:
        write_text(document, to_json(made) + "\n")
    write_text(path, page)
    return made
