"""`load_intrinsics`: a lens that another program has calibrated."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from lasercal_gtsam.cell import INTRINSIC_NAMES, Camera, Cell, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats import kalibr, mrcal_model, opencv_storage, plain_data, ros_camera_info
from lasercal_gtsam.formats.fields import Fields, decoded
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.io.files import read_bytes
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.report_map import CAMERA_TANGENT

READABLE = (
    "ROS camera_info YAML (plumb_bob), Kalibr camchain (pinhole, radtan), OpenCV FileStorage "
    "(YAML, XML, JSON), mrcal .cameramodel (LENSMODEL_OPENCV4), and lasercal's calibration.json, "
    "JSON and NPZ exports"
)


@dataclass(frozen=True, eq=False)
class GivenIntrinsics(FrozenData):
    """A lens out of a file.

    Attributes
    ----------
    intrinsics : the lens; pixel (0, 0) is the centre of the top-left pixel in all formats read
    image_size : (width, height) px of the pictures it belongs to; None where the file does not say
    covariance : (9, 9) in the order of `INTRINSIC_NAMES`, px; None where the file has none
    name : of the camera in the file; "" where it has none
    form : which kind of file it was
    path : of the file
    """

    intrinsics: Intrinsics
    image_size: tuple[int, int] | None
    covariance: Array | None
    name: str
    form: str
    path: str

    def __post_init__(self) -> None:
        if self.covariance is not None:
            set_array(self, "covariance", self.covariance, (9, 9))

    @property
    def sigmas(self) -> dict[str, float]:
        """Sigma of each intrinsic; empty where the file has no covariance."""
        if self.covariance is None:
            return {}
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return dict(zip(INTRINSIC_NAMES, sigmas.tolist(), strict=True))


def load_intrinsics(path: str | Path, camera: str | None = None) -> GivenIntrinsics:
    """Read the intrinsics of a camera; the kind of file is told by its content.

    Parameters
    ----------
    path : file of one of the kinds in `READABLE`
    camera : name in the file (``cam0`` in a Kalibr chain), where it has several

    Raises
    ------
    DataError
        Not readable, of another kind, of a lens model that is not ours, with numbers missing or
        wrong: with file, line where the format allows it, key, what was found and expected.
    """
    path = Path(path)
    content = read_bytes(path)
    name = str(path)
    if content.startswith(b"PK"):
        return _from_npz(content, name, camera)
    text = decoded(content, name)
    start = text.lstrip()
    if not start:
        raise DataError(f"{name}: the file is empty")
    if start.startswith("{") and "lasercal-" in text[:2000]:
        return _from_json(text, name, camera)
    if start.startswith(("%YAML:1.0", "<?xml", "<opencv_storage")) or "opencv-matrix" in text:
        lens, size, covariance = opencv_storage.intrinsics_of(content, name)
        return GivenIntrinsics(lens, size, covariance, "", "OpenCV FileStorage", name)
    if "'lensmodel'" in text or "'lens_model'" in text or '"lensmodel"' in text:
        lens, size = mrcal_model.intrinsics_of(mrcal_model.fields_of(content, name))
        return GivenIntrinsics(lens, size, None, "", "mrcal cameramodel", name)
    fields = Fields.yaml(content, name)
    if labels := kalibr.cameras_in(fields):
        label = _one_of(labels, camera, name)
        lens, size = kalibr.intrinsics_of(fields, label)
        return GivenIntrinsics(lens, size, None, label, "Kalibr camchain", name)
    if "camera_matrix" in fields:
        lens, size, found = ros_camera_info.intrinsics_of(fields)
        return GivenIntrinsics(lens, size, None, found, "ROS camera_info", name)
    raise DataError(
        f"{name}: this is no file of intrinsics that can be read; its keys are "
        f"{some(fields.keys)}; readable are {READABLE}"
    )


def _from_json(text: str, name: str, camera: str | None) -> GivenIntrinsics:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f"{name}:{error.lineno}:{error.colno}: not JSON: {error.msg}") from None
    from lasercal_gtsam.io.cell_file import FORMATS, load_cell

    cell = load_cell(name, (*FORMATS, plain_data.FORMAT))
    try:
        covariance = data.get("covariance") or {"labels": (), "matrix": ()}
        labels = tuple(covariance["labels"])
        matrix = [[np.nan if x is None else x for x in row] for row in covariance["matrix"]]
        return _from_cell(cell, labels, np.array(matrix, dtype=np.float64), name, camera)
    except (TypeError, ValueError, IndexError, KeyError):
        raise DataError(f"{name}: covariance: expected labels and a square matrix") from None


def _from_npz(content: bytes, name: str, camera: str | None) -> GivenIntrinsics:
    try:
        held = plain_data.read_npz(content)
        cameras = {
            k: Camera(lens, held.poses[k], held.image_size[k])
            for k, lens in held.intrinsics.items()
        }
        covariance: Any = held.covariance
        return _from_cell(Cell(cameras, {}), held.labels, covariance, name, camera)
    except (TypeError, ValueError, LookupError, OSError, EOFError, BadZipFile) as error:
        raise DataError(f"{name}: not an export of the format npz: {error}") from None


def _from_cell(
    cell: Cell, labels: tuple[str, ...], covariance: Array, name: str, camera: str | None
) -> GivenIntrinsics:
    chosen = _one_of(list(cell.cameras), camera, name)
    found = cell.cameras[chosen]
    wanted = [f"{chosen}.{term}" for term in CAMERA_TANGENT[6:]]
    block = None
    if set(wanted) <= set(labels):
        rows = [labels.index(label) for label in wanted]
        block = covariance[np.ix_(rows, rows)]
        block = block if np.isfinite(block).all() else None
    return GivenIntrinsics(found.intrinsics, found.image_size, block, chosen, "lasercal", name)


def _one_of(names: list[str], wanted: str | None, where: str) -> str:
    if wanted in names:
        return str(wanted)
    if wanted is None and len(names) == 1:
        return names[0]
    said = "none was named" if wanted is None else f"{wanted!r} is not among them"
    raise DataError(f"{where}: the file has {', '.join(names) or 'no camera'}; {said}")
