"""`export`: a calibration into another program's file, read back before it is written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.held import check_same
from lasercal_gtsam.formats.registry import format_named
from lasercal_gtsam.formats.skew import check_skew, refit_without_skew
from lasercal_gtsam.formats.source import DEFAULT_PARENT, gather
from lasercal_gtsam.io.files import write_bytes

Skew = Literal["refuse", "refit"]


@dataclass(frozen=True)
class Exported:
    """A file's content.

    Attributes
    ----------
    format : name of the format
    content : what was, or is to be, written
    path : where it was written; None if it was not
    notes : what the format could not hold, or what was done to make it fit
    """

    format: str
    content: bytes
    path: Path | None
    notes: tuple[str, ...]


def export(
    calibration: Calibration,
    format: str,
    path: str | Path | None = None,
    *,
    camera: str | None = None,
    parent: str = DEFAULT_PARENT,
    child: str | None = None,
    skew: Skew = "refuse",
    keep_unconverged: bool = False,
    origin: str | None = None,
) -> Exported:
    """Write a calibration in another program's format.

    Parameters
    ----------
    calibration : the result
    format : a name out of `registry.FORMATS`
    path : where to write it, atomically; None: nowhere, the content is returned all the same
    camera : name; may be left out where the cell has one. Formats of whole cells take all cameras,
        or the named one
    parent : frame name of the robot base: of the base that the hand poses refer to. In ROS-I that
        is ``base``; ``base_link`` may be turned against it
    child : frame name of the camera's optical frame; ``<camera>_optical_frame`` if left out
    skew : what is done where the format has no place for a skew that is not zero within its sigma.
        ``"refuse"``; or ``"refit"``: calibrate again with it held at 0, in any format, so that
        files of intrinsics and of poses belong together
    keep_unconverged : export also a calibration that did not converge
    origin : where the calibration comes from, for the head of the file

    Raises
    ------
    DataError
        Unknown names, a skew or a covariance that cannot be written, a content that reads back as
        something else (then nothing is written), or a file that cannot be written.
    """
    form = format_named(format)
    if skew not in ("refuse", "refit"):
        raise DataError(f"skew: expected 'refuse' or 'refit', got {skew!r}")
    if not (calibration.fit.converged or keep_unconverged):
        raise DataError(
            f"the calibration is not to be exported: {calibration.fit.status}; if you must, "
            "--keep-unconverged (keep_unconverged=True)"
        )
    notes: tuple[str, ...] = ()
    if skew == "refit":
        calibration, words = refit_without_skew(calibration)
        notes = (words,)
        origin = words if origin is None else f"{origin}, {words}"
    source = gather(calibration, form, camera, parent, child, origin)
    if form.has_intrinsics and not form.has_skew:
        notes += check_skew(calibration, tuple(source.cameras), form.name)
    content, wanted, more = form.write(source)
    check_same(form.read(content), wanted)
    target = None if path is None else Path(path)
    if target is not None:
        write_bytes(target, content)
    return Exported(form.name, content, target, notes + more)
