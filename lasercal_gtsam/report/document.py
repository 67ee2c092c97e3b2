"""The report as one plain dictionary: everything that is shown, in the order in which it is asked.

`make_document` needs no files and draws nothing; `html.render` makes a page of its result.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.figures import (
    correlation,
    error_maps,
    image_coverages,
    plane_coverages,
    residual_fields,
    residual_histograms,
    scene,
)
from lasercal_gtsam.io.capture import Capture
from lasercal_gtsam.io.spot_account import SpotAccount
from lasercal_gtsam.report.conventions import conventions_section
from lasercal_gtsam.report.figure_sections import (
    correlation_section,
    coverage_section,
    error_section,
    residuals_section,
    scene_section,
)
from lasercal_gtsam.report.inputs import inputs_section
from lasercal_gtsam.report.judgement import (
    levels_section,
    model_error_section,
    summary,
    verdict_section,
    weak_section,
)
from lasercal_gtsam.report.material import Material, Origin, gather
from lasercal_gtsam.report.rejected import rejected_section
from lasercal_gtsam.report.table import Intervals, parameters_section

FORMAT = "lasercal-report"
VERSION = 1


def make_document(
    calibration: Calibration,
    *,
    origin: Origin | None = None,
    capture: Capture | None = None,
    account: SpotAccount | None = None,
    intervals: Intervals | None = None,
    created: datetime | None = None,
) -> dict[str, Any]:
    """Everything that the report shows, as plain dicts, lists, strings and numbers.

    Parameters
    ----------
    calibration : the result to report on
    origin : where it came from, as far as known
    capture : what it was made from, for pictures of the spots that were left out
    account : what became of the capture's rows (`Capture.detections`)
    intervals : 95 % intervals of the rows (`lasercal_gtsam.intervals`); None: those by sigma
    created : time to note; None: now (UTC)

    Returns
    -------
    dict
        JSON can hold it: no NaN (None stands for what is not known). Units are in the keys. Its
        size is bounded: of very many spots a sample is listed, and the sample is named as such.
    """
    material = gather(calibration, origin, capture, account)
    created = datetime.now(UTC) if created is None else created.astimezone(UTC)
    maps = error_maps(calibration, material.halves)
    return {
        "format": FORMAT,
        "version": VERSION,
        "title": _title(calibration),
        "created": created.isoformat(timespec="seconds"),
        "language": "en",
        "summary": summary(material, maps),
        "verdict": verdict_section(material),
        "parameters": parameters_section(calibration, intervals),
        "rejected": rejected_section(material),
        "residuals": residuals_section(
            calibration,
            residual_fields(calibration),
            residual_histograms(calibration, material.bench),
        ),
        "levels": levels_section(material),
        "coverage": coverage_section(
            calibration, image_coverages(calibration), plane_coverages(calibration)
        ),
        "error_maps": error_section(
            maps, None if maps else _no_maps(material), material.halves_trouble
        ),
        "correlation": correlation_section(correlation(calibration)),
        "weak": weak_section(material),
        "scene": scene_section(scene(calibration)),
        "model_error": model_error_section(material),
        "conventions": conventions_section(),
        "inputs": inputs_section(material),
    }


def _title(calibration: Calibration) -> str:
    cell = calibration.cell
    parts = (("camera", cell.cameras), ("laser", cell.lasers), ("plane", cell.planes))
    words = ", ".join(
        f"{len(names)} {kind}{'' if len(names) == 1 else 's'}" for kind, names in parts
    )
    return f"Calibration of {words}"


def _no_maps(material: Material) -> str:
    if not np.isfinite(material.calibration.fit.sigma0):
        return "There are no degrees of freedom left, so no sigmas and no expected error."
    return "No camera sees a plane that was calibrated."
