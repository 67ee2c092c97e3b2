"""``calibration.json``: the result with everything that made it; loads back to an equal object."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from lasercal_gtsam.calibration import Calibration, Inputs, SpotResults
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_json, write_text
from lasercal_gtsam.io.plain import cell_to_dict, observations_to_dict, plain, to_json
from lasercal_gtsam.io.wording import at_most

FORMAT = "lasercal-calibration"
VERSION = 1


def to_dict(
    calibration: Calibration,
    *,
    created: datetime | None = None,
    sources: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """The content of ``calibration.json``: plain dicts, lists, strings and numbers.

    Parameters
    ----------
    calibration : Calibration
    created : time to note; None: now (UTC)
    sources : file name to SHA-256 of the files that the observations were read from
        (``Capture.provenance``)

    Notes
    -----
    Numbers are exact (shortest text that reads back). NaN is written as null, infinities as "inf"
    and "-inf". Poses carry the 4x4 matrix beside translation and quaternion, since a quaternion
    alone does not give the same matrix to the last digit.
    """
    created = datetime.now(UTC) if created is None else created.astimezone(UTC)
    inputs = _inputs(calibration.inputs)
    return {
        "format": FORMAT,
        "version": VERSION,
        **cell_to_dict(calibration.cell),
        "parameters": [plain(parameter) for parameter in calibration.parameters],
        "covariance": {
            "labels": list(calibration.labels),
            "matrix": plain(calibration.covariance),
        },
        "fit": plain(calibration.fit),
        "spots": _spots(calibration.spots),
        "observability": plain(calibration.observability),
        "initial": cell_to_dict(calibration.initial),
        "inputs": inputs,
        "provenance": {
            "version": program_version(),
            "created": created.isoformat(timespec="seconds"),
            "sha256": _digest(inputs),
            "files": dict(sources or {}),
        },
    }


def inputs_digest(calibration: Calibration) -> str:
    """SHA-256 of spots and options: the same for two results from the same inputs."""
    return _digest(_inputs(calibration.inputs))


def save_calibration(
    calibration: Calibration,
    path: str | Path,
    *,
    sources: Mapping[str, str] | None = None,
) -> None:
    """Write ``calibration.json`` atomically: the old file stays until the new one is whole.

    Raises
    ------
    DataError
        The file cannot be written.
    """
    write_text(path, to_json(to_dict(calibration, sources=sources)) + "\n")


def load_calibration(path: str | Path) -> Calibration:
    """Read ``calibration.json``.

    Returns
    -------
    Calibration
        Equal to the one that was saved.

    Raises
    ------
    DataError
        Not JSON (with line and column), not such a file, of a newer version, or with keys missing
        or wrong (all of them, each with its path).
    """
    from pydantic import ValidationError

    from lasercal_gtsam.io.calibration_model import CalibrationModel
    from lasercal_gtsam.io.schema import dotted, validation_problems

    path = Path(path)
    data = _read_json(path)
    try:
        return CalibrationModel.model_validate(data).build()
    except ValidationError as error:
        problems = [
            f"{dotted(location)}: {text}"
            for location, text in validation_problems(error, CalibrationModel)
        ]
    except DataError as error:
        problems = list(error.problems)
    raise DataError(*at_most([f"{path}: {text}" for text in problems]))


def _read_json(path: Path) -> Any:
    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = repr(data.get("format")) if isinstance(data, dict) else f"a {type(data).__name__}"
        raise DataError(
            f"{path}: not a calibration: expected a mapping with format {FORMAT!r}, got {found}"
        )
    version = data.get("version")
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        raise DataError(
            f"{path}: version {version!r} of the format, this program reads version {VERSION}"
            + ("; use a newer lasercal-gtsam" if newer else "")
        )
    return data


def _spots(spots: SpotResults) -> list[dict[str, Any]]:
    """One mapping a spot, with the keys in the order of the fields."""
    names = [f.name for f in fields(spots)]
    columns = [plain(getattr(spots, name)) for name in names]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def _inputs(inputs: Inputs) -> dict[str, Any]:
    return {
        "observations": observations_to_dict(inputs.observations),
        "options": plain(inputs.options),
    }


def program_version() -> str:
    """Version of this package; "unknown" where it is not installed."""
    return package_version("lasercal-gtsam")


def package_version(name: str) -> str:
    """Version of an installed package; "unknown" where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


def _digest(inputs: Mapping[str, Any]) -> str:
    """SHA-256 of the inputs' content: the same for two results from the same inputs."""
    text = json.dumps(inputs, allow_nan=False, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
