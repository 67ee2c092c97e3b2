"""Kalibr's camchain: pinhole-radtan cameras, each placed in the one before it.

``intrinsics: [fu, fv, pu, pv]``, ``distortion_coeffs: [k1, k2, p1, p2]``; ``T_cn_cnm1`` takes
points of camera n-1 into camera n (`kalibr_common/ConfigReader.py`). PyYAML reads the file,
so that numbers must be written with a point; a principal point must not be negative. ``T_cam_imu``
belongs to another calibration, and the robot's base has no place.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.fields import Fields, decoded, silent_yaml_1_1
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.ros_camera_info import quoted
from lasercal_gtsam.formats.source import Source, without_skew_term
from lasercal_gtsam.formats.text import comment, numbers
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture_rows import inverse_poses

_ALL = "fu fv pu pv"


def write_camchain(source: Source) -> Written:
    """All cameras, in the order of the cell."""
    cameras = source.cameras
    text = comment(source.remarks)
    relative: dict[tuple[str, str], Array] = {}
    before: Array | None = None
    for i, (name, camera) in enumerate(cameras.items()):
        lens, T = camera.intrinsics, camera.T_base_camera
        if min(lens.u0, lens.v0) < 0:
            raise DataError(
                f"camera {name!r}: Kalibr takes no negative principal point, here "
                f"({lens.u0:.6g}, {lens.v0:.6g}) px"
            )
        overlaps = ", ".join(str(k) for k in range(len(cameras)) if k != i)
        text += (
            f"cam{i}:  {comment([name])}"
            f"  camera_model: pinhole\n"
            f"  intrinsics: [{numbers([lens.fu, lens.fv, lens.u0, lens.v0])}]\n"
            f"  distortion_model: radtan\n"
            f"  distortion_coeffs: [{numbers(lens.dist_coeffs[:4])}]\n"
            f"  resolution: [{camera.image_size[0]}, {camera.image_size[1]}]\n"
            f"  cam_overlaps: [{overlaps}]\n"
            f"  rostopic: {quoted(f'/{name}/image_raw')}\n"
        )
        if before is not None:
            chain = inverse_poses(T[None])[0] @ before
            relative[f"cam{i}", f"cam{i - 1}"] = chain
            text += "  T_cn_cnm1:\n" + "".join(f"  - [{numbers(row)}]\n" for row in chain)
        before = T
    wanted = Held(
        relative=relative,
        intrinsics={
            f"cam{i}": without_skew_term(c.intrinsics) for i, c in enumerate(cameras.values())
        },
        image_size={f"cam{i}": c.image_size for i, c in enumerate(cameras.values())},
    )
    base = "Kalibr has no place for the base: where the cameras are in it is not in this file"
    return Written(text.encode(), wanted, (base,))


def read_camchain(content: bytes) -> Held:
    """Read the chain as Kalibr does."""
    chain = silent_yaml_1_1(decoded(content, "camchain"))
    relative, lenses, sizes = {}, {}, {}
    for i, (label, camera) in enumerate(chain.items()):
        fu, fv, u0, v0 = camera["intrinsics"]
        lenses[label] = Intrinsics(fu, fv, 0.0, u0, v0, *camera["distortion_coeffs"])
        sizes[label] = (camera["resolution"][0], camera["resolution"][1])
        if i:
            relative[label, f"cam{i - 1}"] = np.array(camera["T_cn_cnm1"], dtype=np.float64)
    return Held(relative=relative, intrinsics=lenses, image_size=sizes)


def cameras_in(fields: Fields) -> list[str]:
    """Labels of the cameras of a chain, ``cam0`` and so on."""
    return [key for key in fields.keys if key.startswith("cam") and key[3:].isdecimal()]


def intrinsics_of(fields: Fields, label: str) -> tuple[Intrinsics, tuple[int, int]]:
    """Intrinsics and picture size of one camera; `DataError` where ours is another model."""
    camera = fields.inside(label)
    model = camera.text("camera_model")
    terms, lens = None, None
    if model is not None and model != "pinhole":
        camera.add("camera_model", f"{model!r} is another model than ours, which is pinhole-radtan")
    elif model is not None:
        lens = camera.row("intrinsics", 4, _ALL)
    distortion = camera.text("distortion_model")
    if distortion == "none":
        terms = np.zeros(4)
    elif distortion == "radtan":
        terms = camera.row("distortion_coeffs", 4, "k1 k2 p1 p2")
    elif distortion is not None:
        camera.add(
            "distortion_model", f"{distortion!r} is another model than ours, which is radtan"
        )
    size = camera.row("resolution", 2, "width height")
    if size is not None and ((size <= 0).any() or (size != np.floor(size)).any()):
        camera.add("resolution", f"expected whole numbers above 0, got {size.tolist()}")
    if lens is not None and not (lens[:2] > 0).all():
        camera.add("intrinsics", f"focal lengths must be above 0, got {lens[:2].tolist()}")
    fields.check()
    assert lens is not None and terms is not None and size is not None
    fu, fv, u0, v0 = lens
    return Intrinsics(fu, fv, 0.0, u0, v0, *terms), (int(size[0]), int(size[1]))
