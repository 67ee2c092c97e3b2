"""OpenCV `FileStorage` YAML: ``camera_matrix``, ``distortion_coefficients`` and more.

OpenCV writes and reads it itself. `cv2.projectPoints` and `cv2.undistort` look only at the focal
lengths and the principal point of a camera matrix, so that a skew would be lost in silence there.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.fields import decoded
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.ros_camera_info import pinhole
from lasercal_gtsam.formats.source import Source, without_skew_term
from lasercal_gtsam.formats.text import one_line
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report_map import CAMERA_TANGENT

# how OpenCV's own calibrators, old and new, call them
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_WIDTH = ("image_width", "image_Width")
_HEIGHT = ("image_height", "image_Height")
_COUNTS = (4, 5, 8, 12, 14)
_LARGEST_SIZE = 65535
_TAG = re.compile(r"!![^\s,\]}]*")
_TAGS = ("!!opencv-matrix", "!!map", "!!seq", "!!int", "!!float", "!!str")


def write_storage(source: Source) -> Written:
    """One camera with its pose and the joint covariance of both."""
    import cv2

    camera, covariance = source.only_camera, source.camera_covariance
    lens = without_skew_term(camera.intrinsics)
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage(".yaml", flags)
    for line in source.remarks:
        storage.writeComment(one_line(line))
    storage.write("image_width", camera.image_size[0])
    storage.write("image_height", camera.image_size[1])
    storage.write("camera_name", source.name)
    storage.write("camera_matrix", lens.K)
    storage.write("distortion_coefficients", lens.dist_coeffs[:, None])
    storage.write("parent_frame", source.parent)
    storage.write("child_frame", source.child)
    storage.writeComment("T_parent_child takes points of the child frame into the parent (metres)")
    storage.write("T_parent_child", np.array(camera.T_base_camera))
    notes: tuple[str, ...] = ()
    if covariance is None:
        notes = (f"camera {source.name!r} has no sigmas: no covariance was written",)
    else:
        storage.writeComment(
            "rot and trans: small rotation (rad) and translation (m) in the child frame: "
            "R exp([rot]x), t + R trans; the rest as named (pixels)"
        )
        storage.startWriteStruct("covariance_labels", cv2.FileNode_SEQ)
        for label in CAMERA_TANGENT:
            storage.write("", label)
        storage.endWriteStruct()
        storage.write("covariance", covariance)
    wanted = Held(
        poses={source.child: camera.T_base_camera},
        intrinsics={source.name: lens},
        image_size={source.name: camera.image_size},
        frames=(source.parent, source.child),
        covariance=covariance,
        labels=() if covariance is None else CAMERA_TANGENT,
    )
    return Written(storage.releaseAndGetString().encode(), wanted, notes)


def read_storage(content: bytes) -> Held:
    """Read with OpenCV what `write_storage` writes."""
    storage = opened(content, "OpenCV file")
    name, parent, child = (
        storage.getNode(key).string() for key in ("camera_name", "parent_frame", "child_frame")
    )
    labels = storage.getNode("covariance_labels")
    lens, size, covariance = intrinsics_of(content, "OpenCV file")
    held = covariance is not None
    return Held(
        poses={child: storage.getNode("T_parent_child").mat()},
        intrinsics={name: lens},
        image_size={} if size is None else {name: size},
        frames=(parent, child),
        covariance=storage.getNode("covariance").mat() if held else None,
        labels=tuple(labels.at(i).string() for i in range(labels.size())) if held else (),
    )


def opened(content: bytes, name: str) -> Any:
    """A `cv2.FileStorage` of YAML, XML or JSON; `DataError` where OpenCV cannot read it."""
    import cv2

    text = decoded(content, name)
    for tag in _TAG.finditer(text):
        if tag[0] not in _TAGS:  # OpenCV never comes back from some
            line = text.count("\n", 0, tag.start()) + 1
            raise DataError(
                f"{name}:{line}: {tag[0]:.60}: expected no tag but {', '.join(_TAGS)}; what is "
                "packed or sparse, write out as plain numbers"
            )
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise _unreadable(name, error) from None
    if not storage.isOpened():
        raise DataError(f"{name}: OpenCV cannot read it")
    return storage


def intrinsics_of(
    content: bytes, name: str
) -> tuple[Intrinsics, tuple[int, int] | None, Array | None]:
    """Intrinsics, picture size (if it is there) and covariance (9, 9) of the intrinsics, or None.

    Raises
    ------
    DataError
        Not readable, without a camera matrix or distortion, or of a lens that is not ours.
    """
    import cv2

    try:
        return _read(opened(content, name), name)
    except cv2.error as error:  # a list where a mapping should be, and the like
        raise _unreadable(name, error) from None


def _unreadable(name: str, error: Exception) -> DataError:
    text = " ".join(str(error.__cause__ or error).split())
    return DataError(f"{name}: OpenCV cannot read it: {text:.200}")


def _read(storage: Any, name: str) -> tuple[Intrinsics, tuple[int, int] | None, Array | None]:
    K = _matrix(storage, _MATRIX, name)
    D = _matrix(storage, _DISTORTION, name).ravel()
    problems = []
    if K.shape != (3, 3):
        problems.append(
            f"{name}: camera_matrix: expected 3 x 3, got {' x '.join(map(str, K.shape))}"
        )
    elif not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        problems.append(f"{name}: camera_matrix: expected focal lengths above 0, got {K.tolist()}")
    elif K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
        problems.append(f"{name}: camera_matrix: expected a last row of 0 0 1, got {K.tolist()}")
    if D.size not in _COUNTS:
        problems.append(
            f"{name}: distortion_coefficients: expected 4 or 5 (k1, k2, p1, p2, k3), got {D.size}"
        )
    elif not np.isfinite(D).all() or (D[4:] != 0).any():
        problems.append(
            f"{name}: distortion_coefficients: our model has k1, k2, p1, p2 only, the rest must be "
            f"0; got {D.tolist()}"
        )
    if problems:
        raise DataError(*problems)
    return pinhole(K, D[:4]), _size(storage, name), _covariance(storage, name)


def _covariance(storage: Any, name: str) -> Array | None:
    """Block of the intrinsics of the covariance that `write_storage` writes."""
    labels, matrix = storage.getNode("covariance_labels"), storage.getNode("covariance")
    if labels.empty() or matrix.empty():
        return None
    nodes = [labels.at(i) for i in range(labels.size())]
    found = tuple(node.string() if node.isString() else "" for node in nodes)
    values = _mat(matrix)
    if found != CAMERA_TANGENT or values is None or values.shape != (15, 15):
        raise DataError(f"{name}: covariance: expected 15 x 15 of {', '.join(CAMERA_TANGENT)}")
    return np.asarray(values[6:, 6:], dtype=np.float64)


def _size(storage: Any, name: str) -> tuple[int, int] | None:
    found = []
    for keys in (_WIDTH, _HEIGHT):
        nodes = [node for key in keys if not (node := storage.getNode(key)).empty()]
        if not nodes:
            return None
        value = nodes[0].real() if nodes[0].isInt() or nodes[0].isReal() else 0.0
        if not (0 < value <= _LARGEST_SIZE and value == int(value)):
            raise DataError(f"{name}: {keys[0]}: expected a whole number of pixels above 0")
        found.append(int(value))
    return found[0], found[1]


def _mat(node: Any) -> Any:
    """A node's matrix; None where it is none."""
    import cv2

    try:
        return node.mat() if node.isMap() else None
    except cv2.error:  # fewer numbers than rows and columns
        return None


def _matrix(storage: Any, keys: tuple[str, ...], name: str) -> Array:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty():
            matrix = _mat(node)
            if matrix is None:
                raise DataError(f"{name}: {key}: expected an OpenCV matrix of rows x cols numbers")
            return np.asarray(matrix, dtype=np.float64)
    raise DataError(f"{name}: there is no {keys[0]} (nor {', '.join(keys[1:])})")
