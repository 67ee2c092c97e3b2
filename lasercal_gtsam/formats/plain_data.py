"""Everything as plain JSON or as NumPy arrays: cameras, beams, planes and their joint covariance.

The covariance is in the tangent coordinates of `report_map`. What they need to be read without this
package is in the file: the axes across each beam and each plane's normal.
"""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from lasercal_factors.beam import BeamFrame

from lasercal_gtsam.cell import INTRINSIC_NAMES, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.source import Source
from lasercal_gtsam.io.plain import cell_to_dict, plain, to_json
from lasercal_gtsam.report_map import CAMERA_TANGENT
from lasercal_gtsam.rotations import basis_of

FORMAT = "lasercal-export"
_TANGENT = (
    "rot, trans of a camera: small rotation (rad) and translation (m) in the camera frame, "
    "R exp([rot]x), t + R trans; intrinsics: added (px)",
    "slope_a, slope_b, offset_x, offset_y of a laser: it runs along axes_hand (a, b, 1) through "
    "point_hand_m + axes_hand (x, y, 0)",
    "normal_1, normal_2 of a plane: n + tangent_base (3 x 2, columns) (n1, n2), normalised; "
    "distance: n . x = distance (m)",
)


def write_json(source: Source) -> Written:
    """A document for people and programs."""
    parts: dict[str, Any] = cell_to_dict(source.cell)
    parts["cameras"] = {
        name: {
            "frame": source.children[name],
            **parts["cameras"][name],
            "K": plain(camera.intrinsics.K),
            "dist_coeffs": plain(camera.intrinsics.dist_coeffs),
        }
        for name, camera in source.cameras.items()
    }
    for name, axes in _beam_axes(source).items():
        parts["lasers"][name]["axes_hand"] = plain(axes)
    for name, plane in source.cell.planes.items():
        parts["planes"][name]["tangent_base"] = plain(basis_of(plane.normal_base))
    rows = _rows(source)
    document = {
        "format": FORMAT,
        "version": 1,
        "remarks": list(source.remarks),
        "base_frame": source.parent,
        **parts,
        "covariance": {
            "tangent": list(_TANGENT),
            "labels": [source.labels[i] for i in rows],
            "matrix": plain(source.covariance[np.ix_(rows, rows)]),
        },
    }
    return Written((to_json(document) + "\n").encode(), _wanted(source))


def read_json(content: bytes) -> Held:
    """Read the document; the intrinsics from K and dist_coeffs."""
    data = json.loads(content)
    if data.get("format") != FORMAT:
        raise DataError(f"expected format {FORMAT!r}, got {data.get('format')!r}")
    cameras, covariance = data["cameras"], data["covariance"]
    matrix = [[np.nan if x is None else x for x in row] for row in covariance["matrix"]]
    return _held(
        {name: np.array(c["T_base_camera"]["matrix"]) for name, c in cameras.items()},
        {name: _pinhole(c["K"], c["dist_coeffs"]) for name, c in cameras.items()},
        {name: (c["image_size"][0], c["image_size"][1]) for name, c in cameras.items()},
        np.array(matrix, dtype=np.float64),
        tuple(covariance["labels"]),
    )


def write_npz(source: Source) -> Written:
    """Arrays over the cameras, lasers and planes."""
    cameras, cell = source.cameras, source.cell
    rows = _rows(source)
    arrays = {
        "format": FORMAT,
        "remarks": list(source.remarks),
        "tangent": list(_TANGENT),
        "base_frame": source.parent,
        "camera_names": list(cameras),
        "camera_frames": [source.children[name] for name in cameras],
        "image_size": [c.image_size for c in cameras.values()],
        "intrinsic_names": list(INTRINSIC_NAMES),
        "intrinsics": [c.intrinsics.vector for c in cameras.values()],
        "T_base_camera": [c.T_base_camera for c in cameras.values()],
        "laser_names": list(cell.lasers),
        "laser_direction_hand": [b.direction_hand for b in cell.lasers.values()],
        "laser_point_hand_m": [b.point_hand for b in cell.lasers.values()],
        "laser_axes_hand": list(_beam_axes(source).values()),
        "plane_names": list(cell.planes),
        "plane_normal_base": [p.normal_base for p in cell.planes.values()],
        "plane_distance_m": [p.distance for p in cell.planes.values()],
        "plane_tangent_base": [basis_of(p.normal_base) for p in cell.planes.values()],
        "labels": [source.labels[i] for i in rows],
        "covariance": source.covariance[np.ix_(rows, rows)],
    }
    return Written(npz_bytes(arrays), _wanted(source))


def read_npz(content: bytes) -> Held:
    """Read the arrays with NumPy."""
    with np.load(io.BytesIO(content), allow_pickle=False) as data:
        names = [str(name) for name in data["camera_names"]]
        lenses = [Intrinsics(**dict(zip(map(str, data["intrinsic_names"]), row, strict=True)))
                  for row in data["intrinsics"].tolist()]  # fmt: skip
        return _held(
            dict(zip(names, data["T_base_camera"], strict=True)),
            dict(zip(names, lenses, strict=True)),
            {n: (int(w), int(h)) for n, (w, h) in zip(names, data["image_size"], strict=True)},
            data["covariance"],
            tuple(str(label) for label in data["labels"]),
        )


def npz_bytes(arrays: dict[str, Any]) -> bytes:
    """Content of an ``.npz`` file; the same arrays give the same bytes."""
    stream = io.BytesIO()
    plain_arrays: Any = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez(stream, **plain_arrays)
    return stream.getvalue()


def _beam_axes(source: Source) -> dict[str, Any]:
    return {
        name: BeamFrame.from_line(beam.direction_hand, beam.point_hand).R
        for name, beam in source.cell.lasers.items()
    }


def _rows(source: Source) -> list[int]:
    """Rows of the covariance without those of cameras that are not exported."""
    others = {
        f"{name}.{term}"
        for name in source.cell.cameras
        if name not in source.cameras
        for term in CAMERA_TANGENT
    }
    return [i for i, label in enumerate(source.labels) if label not in others]


def _wanted(source: Source) -> Held:
    cameras, rows = source.cameras, _rows(source)
    covariance = source.covariance[np.ix_(rows, rows)]
    return _held(
        {name: c.T_base_camera for name, c in cameras.items()},
        {name: c.intrinsics for name, c in cameras.items()},
        {name: c.image_size for name, c in cameras.items()},
        covariance,
        tuple(source.labels[i] for i in rows),
    )


def _held(
    poses: dict[str, Any],
    lenses: dict[str, Intrinsics],
    sizes: dict[str, tuple[int, int]],
    covariance: Any,
    labels: tuple[str, ...],
) -> Held:
    return Held(
        poses=poses, intrinsics=lenses, image_size=sizes, covariance=covariance, labels=labels
    )


def _pinhole(K: Any, terms: Any) -> Intrinsics:
    from lasercal_gtsam.formats.ros_camera_info import pinhole

    return pinhole(np.array(K), np.array(terms[:4]))
