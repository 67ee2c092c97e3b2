"""What is exported: parts of a calibration, names of frames, and the words of a file's head."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lasercal_gtsam.calibration import Calibration, Parameter, table_decimals
from lasercal_gtsam.cell import Camera, Cell, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.registry import Format
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.calibration_file import program_version
from lasercal_gtsam.io.conventions import EXACT_TOLERANCE
from lasercal_gtsam.prediction import only
from lasercal_gtsam.report_map import CAMERA_ROWS, CAMERA_TANGENT
from lasercal_gtsam.rotations import make_pose, nearest_rotation

DEFAULT_PARENT = "base"
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")
_POSE = len(CAMERA_TANGENT) - 9
_NINE_OF_LENS = 9


@dataclass(frozen=True, eq=False)
class Source:
    """What a writer needs.

    Attributes
    ----------
    cell : of which a format for one camera takes ``camera``; rotations are exact to rounding
    covariance, labels : as in `Calibration`, in the tangent coordinates of `report_map`
    camera : name of the camera that is exported; None: all of them
    parent, children : name of the robot base's frame, and of each camera's optical frame
    remarks : lines for the head of the file
    """

    cell: Cell
    covariance: Array
    labels: tuple[str, ...]
    camera: str | None
    parent: str
    children: dict[str, str]
    remarks: tuple[str, ...]

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras that are exported, by name."""
        return {k: c for k, c in self.cell.cameras.items() if self.camera in (None, k)}

    @property
    def name(self) -> str:
        """Name of the only camera."""
        return next(iter(self.cameras))

    @property
    def only_camera(self) -> Camera:
        """The only camera."""
        return self.cameras[self.name]

    @property
    def child(self) -> str:
        """Name of the only camera's frame."""
        return self.children[self.name]

    @property
    def camera_covariance(self) -> Array | None:
        """(15, 15) of the only camera, in `CAMERA_TANGENT`; None where it has no sigmas."""
        where = {label: i for i, label in enumerate(self.labels)}
        rows = [where.get(f"{self.name}.{term}") for term in CAMERA_TANGENT]
        known = [row for row in rows if row is not None]
        if len(known) < len(rows):
            return None
        block = self.covariance[np.ix_(known, known)]
        return block if np.isfinite(block).all() else None

    @property
    def pose_covariance(self) -> Array:
        """(6, 6) of the only camera's pose: rotation, translation in its own frame.

        Raises
        ------
        DataError
            The calibration has no sigmas for this camera.
        """
        covariance = self.camera_covariance
        if covariance is None:
            raise DataError(
                f"camera {self.name!r} has no covariance: "
                + (
                    "no degrees of freedom were left, so that no sigmas can be stated; "
                    if f"{self.name}.rot_x" in self.labels
                    else "no spot of it was in the calibration; "
                )
                + "calibrate with more spots, or export a format without a covariance"
            )
        return covariance[:_POSE, :_POSE]


def gather(
    calibration: Calibration,
    form: Format,
    camera: str | None,
    parent: str,
    child: str | None,
    origin: str | None,
) -> Source:
    """What ``form`` needs of a calibration.

    Raises
    ------
    DataError
        Unknown camera, or none named where there are several; names that cannot be frames.
    """
    cell = _clean(calibration.cell)
    names = tuple(cell.cameras)
    if form.of == "camera" or camera is not None:
        camera = only(names, camera, "camera")
    children = {name: f"{name}_optical_frame" for name in names}
    if child is not None:
        children[only(names, camera, "camera")] = child
    frames = [parent, *(children[name] for name in names if camera in (None, name))]
    if form.has_pose and form.of == "camera":
        _check_frames(frames)
    source = Source(
        cell, calibration.covariance, calibration.labels, camera, parent, children, remarks=()
    )
    return replace(source, remarks=_remarks(calibration, form, source, origin))


def without_skew_term(lens: Intrinsics) -> Intrinsics:
    """The same intrinsics with a skew of 0."""
    values = lens.vector
    values[2] = 0.0
    return Intrinsics.from_vector(values)


def _clean(cell: Cell) -> Cell:
    """The cell with rotations that are rotations to rounding, as angles and quaternions are."""
    cameras = {}
    for name, camera in cell.cameras.items():
        R = camera.T_base_camera[:3, :3]
        nearest = nearest_rotation(R)
        if np.abs(R - nearest).max() > 0.1 * EXACT_TOLERANCE:
            T = make_pose(nearest, camera.T_base_camera[:3, 3])
            camera = Camera(camera.intrinsics, T, camera.image_size)
        cameras[name] = camera
    return Cell(cameras, cell.lasers, cell.planes)


def _check_frames(frames: Sequence[str]) -> None:
    problems = [
        f"frame {name!r}: expected letters, digits and _ . / -, not beginning with a slash "
        "(give --parent, --child)"
        for name in frames
        if not _FRAME.fullmatch(name)
    ]
    if len(set(frames)) < len(frames):
        problems.append(f"frame {frames[0]!r} is given for the parent and for the camera")
    if problems:
        raise DataError(*problems)


def _remarks(
    calibration: Calibration, form: Format, source: Source, origin: str | None
) -> tuple[str, ...]:
    lines = [f"lasercal-gtsam {program_version()}, format {form.name}: {form.summary}"]
    if origin is not None:
        lines.append(f"from {origin}")
    lines.append(f"fit: {calibration.fit.status}")
    for name in source.cameras:
        if form.has_pose:
            lines.append(
                f"camera {name!r}: pose of {source.children[name]!r} (optical frame: z forward, x "
                f"right, y down) in {source.parent!r} (the base that the controller's hand poses "
                "refer to)"
            )
        if not form.has_covariance:
            rows = [row for row, _ in CAMERA_ROWS]
            wanted = rows[:_NINE_OF_LENS] if form.has_intrinsics else []
            wanted += rows[_NINE_OF_LENS:] if form.has_pose else []
            lines.append(f"camera {name!r}, 1 sigma: " + _sigmas(calibration, name, wanted))
    units = ["metres, radians"] if form.has_pose or form.of == "cell" else []
    units += ["pixels; pixel (0, 0) is the centre of the top-left pixel"] * form.has_intrinsics
    lines.append("units: " + ", ".join(units))
    return tuple(lines)


def _sigmas(calibration: Calibration, camera: str, rows: Sequence[str]) -> str:
    prefix = f"{camera}." if len(calibration.cell.cameras) > 1 else ""
    found = {p.name: p for p in calibration.parameters}
    named = [(row, found.get(prefix + row)) for row in rows]
    return ", ".join(f"{row} {_sigma(p)}" for row, p in named)


def _sigma(parameter: Parameter | None) -> str:
    if parameter is None or not np.isfinite(parameter.sigma):
        return "unknown"
    if parameter.sigma == 0:
        return "held"
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.sigma:.{table_decimals(parameter)}f}{unit}"
