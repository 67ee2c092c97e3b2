"""A cell from a JSON file: a calibration, a simulation's truth, or one written from drawings."""

from __future__ import annotations

import json
from pathlib import Path

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_text
from lasercal_gtsam.io.wording import at_most

FORMATS = ("lasercal-cell", "lasercal-calibration", "lasercal-truth")


def load_cell(path: str | Path) -> Cell:
    """Read the cameras, lasers and planes of a JSON file.

    The keys are those of ``calibration.json`` (metres, pixels, units in the names); everything
    else in the file is ignored. A ``matrix`` beside translation and quaternion may be left out.

    Raises
    ------
    DataError
        Not JSON (with line and column), of another format or a newer version, or with keys
        missing or wrong (all of them, each with its path).
    """
    from pydantic import ValidationError

    from lasercal_gtsam.io.calibration_model import CellModel
    from lasercal_gtsam.io.schema import dotted, validation_problems

    path = Path(path)
    text = read_text(path)
    if not text.strip():
        raise DataError(f"{path}: the file is empty")
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f"{path}:{error.lineno}:{error.colno}: not JSON: {error.msg}") from None
    kind = data.get("format", FORMATS[0]) if isinstance(data, dict) else None
    if kind not in FORMATS or data.get("version", 1) != 1:
        raise DataError(
            f"{path}: expected a mapping with cameras, lasers and planes, and if it states a "
            f"format, one of {', '.join(FORMATS)}, version 1"
        )
    problems: list[str] = []
    try:
        cell = CellModel.model_validate(data).build_cell("", problems)
        if cell is not None:
            return cell
    except ValidationError as error:
        problems = [f"{dotted(at)}: {text}" for at, text in validation_problems(error, CellModel)]
    raise DataError(*at_most([f"{path}: {text}" for text in problems]))
