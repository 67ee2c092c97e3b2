"""mrcal's ``.cameramodel``: a Python literal.

``LENSMODEL_OPENCV4``: fx, fy, cx, cy, k1, k2, p1, p2. ``rt_cam_ref`` takes points of the reference,
here the robot base, into the camera: rotation vector (rad), then translation (m). mrcal before 2.5
calls the two keys ``lens_model`` and ``extrinsics`` (mrcal/cameramodel.py): both are written.
"""

from __future__ import annotations

import ast
import warnings
from typing import Any

import numpy as np

from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.fields import Fields, decoded
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.source import Source, without_skew_term
from lasercal_gtsam.formats.text import comment, numbers
from lasercal_gtsam.io.capture_rows import inverse_poses
from lasercal_gtsam.io.conventions import columns_from_rotations
from lasercal_gtsam.io.yaml_text import Lines, Location
from lasercal_gtsam.rotations import make_pose

_LENS = "LENSMODEL_OPENCV4"
_RENAMED = (("lens_model", "lensmodel"), ("extrinsics", "rt_cam_ref"))
# lenses of which ours is a special case, and how many numbers they have
_LENSES = {
    "LENSMODEL_PINHOLE": 4,
    _LENS: 8,
    "LENSMODEL_OPENCV5": 9,
    "LENSMODEL_OPENCV8": 12,
    "LENSMODEL_OPENCV12": 16,
}


def write_model(source: Source) -> Written:
    """One camera and its pose."""
    camera = source.only_camera
    lens = without_skew_term(camera.intrinsics)
    T_camera_base = inverse_poses(camera.T_base_camera[None])
    r = columns_from_rotations("rotvec_rad", T_camera_base[:, :3, :3])[0]
    rt = numbers([*r, *T_camera_base[0, :3, 3]])
    core = numbers([lens.fu, lens.fv, lens.u0, lens.v0, *lens.dist_coeffs[:4]])
    width, height = camera.image_size
    text = (
        f"{comment(source.remarks)}"
        f"# the reference frame is {source.parent!r}\n"
        "{\n"
        f"    'lensmodel':  '{_LENS}',\n"
        f"    'lens_model': '{_LENS}', # for mrcal < 2.5\n\n"
        "    # fx, fy, cx, cy, k1, k2, p1, p2\n"
        f"    'intrinsics': [{core}],\n\n"
        "    # rotation vector and translation from the reference to the camera, rad and m\n"
        f"    'rt_cam_ref': [{rt}],\n"
        f"    'extrinsics': [{rt}], # for mrcal < 2.5\n\n"
        f"    'imagersize': [{width}, {height}],\n"
        "}\n"
    )
    wanted = Held(
        poses={"": camera.T_base_camera},
        intrinsics={"": lens},
        image_size={"": camera.image_size},
    )
    return Written(text.encode(), wanted)


def read_model(content: bytes) -> Held:
    """Read the model; the rotation vector through OpenCV."""
    import cv2

    fields = fields_of(content, "cameramodel")
    lens, size = intrinsics_of(fields)
    rt = fields.row("rt_cam_ref", 6, "rx ry rz tx ty tz")
    fields.check()
    assert rt is not None
    R = np.asarray(cv2.Rodrigues(rt[:3])[0], dtype=np.float64)
    return Held(
        poses={"": make_pose(R.T, -R.T @ rt[3:])}, intrinsics={"": lens}, image_size={"": size}
    )


def fields_of(content: bytes, name: str) -> Fields:
    """Keys of a model, old names made new; `DataError` where the file is none."""
    text = decoded(content, name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd literals, on its way to refusing them
            tree = ast.parse(text, mode="eval").body
        model: Any = ast.literal_eval(tree)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        line = getattr(error, "lineno", None)
        at = name if line is None else f"{name}:{line}"
        raise DataError(f"{at}: not a cameramodel, which is a Python literal") from None
    if not (isinstance(tree, ast.Dict) and isinstance(model, dict)):
        raise DataError(f"{name}: expected a mapping, got {model!r:.60}")
    for old, new in _RENAMED:
        if old in model:
            model.setdefault(new, model[old])
    lines: dict[Location, int] = {
        (str(key.value),): key.lineno for key in tree.keys if isinstance(key, ast.Constant)
    }
    for old, new in _RENAMED:
        if (old,) in lines:
            lines.setdefault((new,), lines[old,])
    return Fields(model, name, Lines(lines))


def intrinsics_of(fields: Fields) -> tuple[Intrinsics, tuple[int, int]]:
    """Intrinsics and picture size; `DataError` where ours is another model."""
    model = fields.text("lensmodel")
    values = None
    if model is not None and model not in _LENSES:
        fields.add("lensmodel", f"{model!r} is another lens model than ours; {_LENS} is the same")
    elif model is not None:
        values = fields.row("intrinsics", _LENSES[model], "fx fy cx cy and the distortion")
    if values is not None and (values[8:] != 0).any():
        fields.add(
            "intrinsics",
            f"our model has k1, k2, p1, p2 only, what follows must be 0; got {values.tolist()}",
        )
    if values is not None and not (values[:2] > 0).all():
        fields.add("intrinsics", f"focal lengths must be above 0, got {values[:2].tolist()}")
    size = fields.row("imagersize", 2, "width height")
    if size is not None and ((size <= 0).any() or (size != np.floor(size)).any()):
        fields.add("imagersize", f"expected whole numbers above 0, got {size.tolist()}")
    fields.check()
    assert values is not None and size is not None
    terms = np.concatenate([values[4:8], np.zeros(4)])[:4]
    fu, fv, u0, v0 = values[:4]
    return Intrinsics(fu, fv, 0.0, u0, v0, *terms), (int(size[0]), int(size[1]))
