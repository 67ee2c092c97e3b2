"""Write a capture that `load_capture` reads back: any pose convention, full precision."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import CAPTURE_FILE
from lasercal_gtsam.io.capture_rows import DEFAULT_LASER, inverse_poses
from lasercal_gtsam.io.conventions import columns_from_rotations, rotation_format
from lasercal_gtsam.io.files import write_text
from lasercal_gtsam.io.spot_account import covariance_cells, number_cells
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.units import MM_PER_M

POSES_FILE = "poses.csv"


def write_capture(
    folder: str | Path,
    observations: Observations,
    *,
    transform: Literal["T_base_hand", "T_hand_base"],
    length: Literal["mm", "m"],
    rotation: str,
    with_spots: bool,
    images: str | Mapping[str, Any] | None = None,
    noise: Mapping[str, float] | None = None,
    known: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``capture.yaml`` and ``poses.csv``; pictures are the caller's.

    Parameters
    ----------
    folder : made if it is not there
    observations : hand poses, names and pixels
    transform, length, rotation : how the poses are written, as in ``capture.yaml``
    with_spots : whether the pixels (with their covariances, where there are any) are written
    images : pattern of the pictures, or a mapping with ``on``, ``off``, ...; as in
        ``capture.yaml``
    noise : ``pixel``, ``hand_translation_mm``, ``hand_rotation_deg``
    known : as in ``CalibrationOptions.known``

    Returns
    -------
    Path
        Of ``capture.yaml``, which is written last.

    Raises
    ------
    DataError
        Unknown convention, ids that are not unique, neither spots nor images, or a folder that
        cannot be written to.
    """
    folder = Path(folder)
    _check(observations, transform, length, with_spots, images)
    description = rotation_format(rotation)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: the folder cannot be made: {error.strerror}") from None
    table = _poses_table(observations, transform, length, rotation, with_spots)
    write_text(folder / POSES_FILE, table)
    sections: list[tuple[str, Any]] = [
        ("lasercal", 1),
        ("camera", _cameras(observations)),
        (
            "poses",
            {
                "file": POSES_FILE,
                "transform": transform,
                "length": length,
                "rotation": description.name,
            },
        ),
        ("images", images),
        ("noise", noise),
        ("known", known or None),
    ]
    lines = [_section(key, value) for key, value in sections if value is not None]
    write_text(folder / CAPTURE_FILE, "\n".join(lines) + "\n")
    return folder / CAPTURE_FILE


def _check(
    observations: Observations, transform: str, length: str, with_spots: bool, images: Any
) -> None:
    problems = []
    if transform not in ("T_base_hand", "T_hand_base"):
        problems.append(f"transform: expected T_base_hand or T_hand_base, got {transform!r}")
    if length not in ("mm", "m"):
        problems.append(f"length: expected mm or m, got {length!r}")
    ids, counts = np.unique(observations.id, return_counts=True)
    if (counts > 1).any():
        problems.append(f"ids must be unique in a capture, but {ids[np.argmax(counts)]!r} is not")
    if not with_spots and images is None:
        problems.append("a capture needs spots or images: set with_spots or give a pattern")
    if problems:
        raise DataError(*(f"write_capture: {text}" for text in problems))


def _cameras(observations: Observations) -> Any:
    cameras = [
        {"name": name, "width": width, "height": height}
        for name, (width, height) in observations.image_size.items()
    ]
    return cameras[0] if len(cameras) == 1 else cameras


def _poses_table(
    observations: Observations, transform: str, length: str, rotation: str, with_spots: bool
) -> str:
    T = observations.T_base_hand
    if transform == "T_hand_base":
        T = inverse_poses(T)
    position = T[:, :3, 3] * MM_PER_M if length == "mm" else T[:, :3, 3]
    angles = columns_from_rotations(rotation, T[:, :3, :3])
    names = {"id": observations.id, "plane": observations.plane}
    if len(observations.image_size) > 1:
        names["camera"] = observations.camera
    if observations.lasers != (DEFAULT_LASER,):
        names["laser"] = observations.laser
    if observations.stop is not None:
        names["stop"] = observations.stop
    header = [*names, "x", "y", "z", *rotation_format(rotation).columns]
    columns = [position, angles]
    has_sigma = False
    if with_spots:
        header += ["u", "v"]
        columns.append(observations.uv)
        has_sigma = not np.isnan(observations.cov_uv).all()
        header += ["sigma_u", "sigma_v", "rho_uv"] if has_sigma else []
    numbers = np.hstack(columns)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for k, row in enumerate(numbers):
        cells = [str(column[k]) for column in names.values()] + number_cells(row)
        writer.writerow(cells + (covariance_cells(observations.cov_uv[k]) if has_sigma else []))
    return text.getvalue()


# --- YAML ---------------------------------------------------------------------------------------


def _section(key: str, value: Any) -> str:
    if key == "poses":
        return "\n".join(["poses:", *(f"  {k}: {_yaml(v)}" for k, v in value.items())])
    if key == "camera" and isinstance(value, Sequence):
        return "\n".join(["camera:", *(f"  - {_yaml(v)}" for v in value)])
    return f"{key}: {_yaml(value)}"


def _yaml(value: Any) -> str:
    """A value on one line; text is quoted where YAML could read it as something else."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {_yaml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, str):
        plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", value)
        reserved = value.lower() in ("true", "false", "null", "yes", "no", "on", "off", "y", "n")
        return value if plain and not reserved else json.dumps(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return repr(float(value))
    return "[" + ", ".join(_yaml(v) for v in value) + "]"
