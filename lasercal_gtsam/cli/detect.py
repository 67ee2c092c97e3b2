"""`lasercal detect`: find the spots in a capture's pictures, and draw them to be looked at."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import Progress, json_option, print_json, progress, warn, wrapped
from lasercal_gtsam.cli.outputs import check_writable
from lasercal_gtsam.cli.texts import account_lines, count, looked_at
from lasercal_gtsam.cli.values import Setting
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.detect.detection import Detection
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.pictures import Picture
    from lasercal_gtsam.io.spot_account import SpotAccount

SPOTS_FILE = "spots.csv"
SHEET_FILE = "contact-sheet.png"


@click.command(
    short_help="Find the spots in a capture's pictures, and draw them.",
    epilog="Settings of the detector: " + ", ".join(f.name for f in fields(DetectionOptions)) + ".",
)
@click.argument("capture", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Where the table of spots goes; the contact sheet goes into the same folder.  "
    f"[default: {SPOTS_FILE} beside the capture]",
)
@click.option(
    "--set",
    "settings",
    type=Setting(),
    metavar="NAME=VALUE",
    multiple=True,
    help="Change a setting of the detector, such as channel=red or ambiguous_ratio=0.5. "
    "Repeatable; the names are below.",
)
@click.option("--force", is_flag=True, help="Replace a table of spots that says something else.")
@json_option
def detect(
    capture: Path,
    output: Path | None,
    settings: tuple[tuple[str, Any], ...],
    force: bool,
    as_json: bool,
) -> None:
    """Find the laser spot in every picture of CAPTURE (capture.yaml, or its folder).

    Writes spots.csv, a line for every picture with pixel, covariance and verdict, and a contact
    sheet to look at. Where capture.yaml refers to a table of spots already, the pictures are looked
    at again.
    """
    from lasercal_gtsam.io.capture import load_capture

    loaded = load_capture(capture)
    warn(loaded.warnings)
    spots = loaded.path.parent / SPOTS_FILE if output is None else output
    if spots.is_dir():
        spots = spots / SPOTS_FILE
    sheet = spots.parent / SHEET_FILE
    check_writable(spots)
    named_spots = _spots_in_head(loaded)
    if named_spots:
        loaded = _unseen(loaded)
    with progress("Looking at pictures") as show:
        account = find_spots(loaded, dict(settings), show)
    warn(account.notes)
    if not looked_at(account):
        raise DataError(
            f"{loaded.path}: there are no pictures to look at: every row has its pixel u, v already"
        )
    _check_replaceable(spots, account, force)
    save_spots(account, spots)
    save_sheet(loaded, account, sheet)
    if as_json:
        print_json(_document(account, loaded, spots, sheet))
    else:
        referred = named_spots is not None and named_spots.resolve() == spots.resolve()
        click.echo("\n".join(_report(account, loaded, spots, sheet, referred)))


def find_spots(
    capture: Capture, settings: Mapping[str, Any], progress: Progress | None = None
) -> SpotAccount:
    """Account for every row of a capture, with settings of the detector other than the defaults."""
    from lasercal_gtsam.detect.pipeline import detect_spot

    options = DetectionOptions(**{"saturation_level": capture.saturation, **settings})

    def detector(on: Picture, off: Picture | None) -> Detection:
        return detect_spot(on, off, options)

    return capture.detections(detector, progress)


def save_spots(account: SpotAccount, path: Path) -> None:
    """Write ``spots.csv``."""
    from lasercal_gtsam.io.spot_account import write_spots

    write_spots(path, account)


def save_sheet(capture: Capture, account: SpotAccount, path: Path) -> None:
    """Write the contact sheet of all pictures that were looked at; one is in memory at a time."""
    import cv2

    from lasercal_gtsam.detect.detection import Detection
    from lasercal_gtsam.detect.sheet import contact_sheet
    from lasercal_gtsam.io.files import write_bytes
    from lasercal_gtsam.io.pictures import read_picture

    seen = [k for k, detection in enumerate(account.detections) if detection is not None]
    sheet = contact_sheet(
        (
            read_picture(image, capture.image_size[str(capture.cameras[k])], account.ids[k])
            for k in seen
            if (image := capture.images_on[k]) is not None
        ),
        [d for d in account.detections if isinstance(d, Detection)],
        [account.ids[k] for k in seen],
    )
    encoded, content = cv2.imencode(".png", sheet)
    if not encoded:
        raise DataError(f"{path}: the contact sheet could not be encoded as PNG")
    write_bytes(path, content.tobytes())


def _spots_in_head(capture: Capture) -> Path | None:
    """Return the table of spots that ``capture.yaml`` refers to."""
    from lasercal_gtsam.io.capture_head import read_head

    head, _ = read_head(capture.path)
    return None if head.spots is None else capture.path.parent / head.spots.file


def _unseen(capture: Capture) -> Capture:
    """Forget what a table of spots says about rows that have a picture."""
    import numpy as np

    has_picture = np.array([image is not None for image in capture.images_on])
    verdicts = zip(capture.verdict, has_picture, strict=True)
    reasons = zip(capture.reason, has_picture, strict=True)
    return replace(
        capture,
        uv=np.where(has_picture[:, None], np.nan, capture.uv),
        cov_uv=np.where(has_picture[:, None, None], np.nan, capture.cov_uv),
        verdict=tuple("" if seen else verdict for verdict, seen in verdicts),
        reason=tuple("" if seen else reason for reason, seen in reasons),
    )


def _check_replaceable(path: Path, account: SpotAccount, force: bool) -> None:
    """Raise `DataError` where a table of spots would be lost, perhaps one corrected by hand."""
    if force or not path.exists():
        return
    with TemporaryDirectory() as folder:
        save_spots(account, Path(folder) / SPOTS_FILE)
        new = (Path(folder) / SPOTS_FILE).read_bytes()
    if path.read_bytes() != new:
        raise DataError(
            f"{path}: there is a table that says something else, perhaps corrected by hand; give "
            "--force to replace it, or another name with -o"
        )


def _report(
    account: SpotAccount, capture: Capture, spots: Path, sheet: Path, referred: bool
) -> list[str]:
    from lasercal_gtsam.detect.detection import Detection

    pictures = looked_at(account)
    single = sum(
        isinstance(found, Detection) and found.single_frame for found in account.detections
    )
    lines = [f"{capture.path}: {count(pictures, 'picture')} looked at"]
    lines.append(f"  used ({sum(account.usable)})")
    lines += account_lines(account, f"all are in {spots}")
    if single:
        lines.append(
            wrapped(
                f"{count(single, 'picture')} without a laser-off picture: every bright thing looks "
                "like a spot there. Take one with the laser off for each pose if you can."
            )
        )
    lines += ["", f"Saved {spots}", f"      {sheet}"]
    lines.append(
        wrapped(
            f"Look at {sheet.name}: every ellipse must sit on a spot. To leave one out, change "
            f"its verdict in {spots.name} from used to any other word."
        )
    )
    if referred:
        lines.append(
            wrapped(
                f"{capture.path.name} takes its spots from there: "
                f"'lasercal calibrate {capture.path.parent}' is next."
            )
        )
    else:
        lines += [
            wrapped(f"To calibrate with these spots, add this line to {capture.path.name}:"),
            f"  spots: {{file: {_relative(spots, capture.path.parent)}}}",
        ]
    return lines


def _relative(path: Path, folder: Path) -> str:
    """Path as ``capture.yaml`` in that folder would name it."""
    return os.path.relpath(path.resolve(), folder.resolve())


def _document(account: SpotAccount, capture: Capture, spots: Path, sheet: Path) -> dict[str, Any]:
    return {
        "capture": str(capture.path),
        "pictures": looked_at(account),
        "verdicts": account.counts,
        "notes": account.notes,
        "spots": [
            {
                "id": row.id,
                "verdict": row.verdict,
                "reason": row.reason,
                "uv_px": row.uv,
                "source": row.source,
            }
            for row in account
        ],
        "saved": {"spots": str(spots), "contact_sheet": str(sheet)},
    }
