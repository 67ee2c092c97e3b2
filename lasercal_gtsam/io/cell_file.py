"""A cell from a JSON file: a calibration, a simulation's truth, or one written from drawings."""

from __future__ import annotations

from pathlib import Path

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_json
from lasercal_gtsam.io.wording import at_most

FORMATS = ("lasercal-cell", "lasercal-calibration", "lasercal-truth")


def load_cell(path: str | Path, formats: tuple[str, ...] = FORMATS) -> Cell:
    """Read the cameras, lasers and planes of a JSON file.

    The keys are those of ``calibration.json`` (metres, pixels, units in the names); everything
    else in the file is ignored. A ``matrix`` beside translation and quaternion may be left out.
    ``formats``: what the file may state to be (stating nothing means the first of `FORMATS`).

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
    data = read_json(path)
    kind = data.get("format", FORMATS[0]) if isinstance(data, dict) else None
    if kind not in formats or data.get("version", 1) != 1:
        raise DataError(
            f"{path}: expected a mapping with cameras, lasers and planes, and if it states a "
            f"format, one of {', '.join(formats)}, version 1"
        )
    problems: list[str] = []
    try:
        cell = CellModel.model_validate(data).build_cell("", problems)
        if cell is not None:
            return cell
    except ValidationError as error:
        problems = [f"{dotted(at)}: {text}" for at, text in validation_problems(error, CellModel)]
    raise DataError(*at_most([f"{path}: {text}" for text in problems]))
