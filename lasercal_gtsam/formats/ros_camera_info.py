"""ROS ``camera_info`` YAML, as `camera_calibration_parsers` of ROS 1 and ROS 2 reads it.

``plumb_bob`` is ``k1 k2 p1 p2 k3`` (`sensor_msgs/CameraInfo`, OpenCV's order), ours with a ``k3``
of 0. ``K`` belongs to the raw picture; without rectification ``R`` is the identity and
``P = [K 0]``.
"""

from __future__ import annotations

import json

import numpy as np

from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.formats.fields import Fields
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.source import Source, without_skew_term
from lasercal_gtsam.formats.text import comment, numbers
from lasercal_gtsam.frozen import Array

PLUMB_BOB = "plumb_bob"
_OTHER_MODELS = ("rational_polynomial", "equidistant", "fisheye", "kannala_brandt4")


def write_camera_info(source: Source) -> Written:
    """One camera's intrinsics."""
    camera = source.only_camera
    lens = without_skew_term(camera.intrinsics)
    width, height = camera.image_size
    text = comment(source.remarks) + "".join(
        [
            f"image_width: {width}\nimage_height: {height}\ncamera_name: {quoted(source.name)}\n",
            _matrix("camera_matrix", lens.K),
            f"distortion_model: {PLUMB_BOB}\n",
            _matrix("distortion_coefficients", lens.dist_coeffs[None]),
            _matrix("rectification_matrix", np.eye(3)),
            _matrix("projection_matrix", np.column_stack([lens.K, np.zeros(3)])),
        ]
    )
    held = Held(intrinsics={source.name: lens}, image_size={source.name: camera.image_size})
    return Written(text.encode(), held)


def read_camera_info(content: bytes) -> Held:
    """Read what `write_camera_info` writes, or a driver, or ROS' own calibrator."""
    fields = Fields.yaml(content, "camera_info")
    lens, size, name = intrinsics_of(fields)
    return Held(intrinsics={name: lens}, image_size={name: size})


def intrinsics_of(fields: Fields) -> tuple[Intrinsics, tuple[int, int], str]:
    """Intrinsics, picture size and camera name; `DataError` where ours cannot be the same model."""
    name = fields.text("camera_name", default="unknown")
    size = fields.size("image_width", "image_height")
    K = fields.matrix("camera_matrix", (3, 3))
    model = fields.text("distortion_model")
    D = fields.matrix("distortion_coefficients")
    if model in _OTHER_MODELS:
        fields.add(
            "distortion_model",
            f"{model!r} is another lens model than ours, which is {PLUMB_BOB} (k1, k2, p1, p2)",
        )
    elif model is not None and model != PLUMB_BOB:
        fields.add("distortion_model", f"expected {PLUMB_BOB}, got {model!r}")
    elif D is not None and len(D) != 5:
        fields.add("distortion_coefficients", f"expected 5 (k1, k2, p1, p2, k3), got {len(D)}")
    elif D is not None and D[4] != 0:
        fields.add("distortion_coefficients", f"k3 = {D[4]:g}: our model has none, it must be 0")
    for key in ("binning_x", "binning_y"):
        if fields.number(key, default=0.0) not in (None, 0.0, 1.0):
            fields.add(key, "a binned picture is not supported: give the file of the whole picture")
    fields.add_unless_pinhole("camera_matrix", K)
    fields.check()
    assert K is not None and D is not None and size is not None and name is not None
    K = K.reshape(3, 3)
    return pinhole(K, D[:4]), size, name


def pinhole(K: Array, terms: Array) -> Intrinsics:
    """Intrinsics of a camera matrix (3, 3) and k1, k2, p1, p2."""
    return Intrinsics(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *terms)


def quoted(name: str) -> str:
    """A YAML string that stays one, whatever is in it: JSON's strings are YAML's too."""
    return json.dumps(name, ensure_ascii=False)


def _matrix(name: str, M: Array) -> str:
    rows, columns = M.shape
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{numbers(M.ravel())}]\n"
