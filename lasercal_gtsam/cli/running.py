"""What `watch` and `update` share: which options a start and a capture give together, and parts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.io.capture import CaptureNoise
    from lasercal_gtsam.options import CalibrationOptions

    _ParamType = click.ParamType[Any]
else:  # no generic class before click 8.2
    _ParamType = click.ParamType

PARTS = ("camera", "laser", "plane")


class PartName(_ParamType):
    """``camera``, ``laser`` or ``plane``, with ``:NAME`` where there are several."""

    name = "part"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        """Split into what it is and its name, "" where none is given."""
        part, _, name = str(value).partition(":")
        if part not in PARTS:
            self.fail(f"{value!r} is not camera, laser or plane[:NAME]", param, ctx)
        return part, name


reset_option = click.option(
    "--reset",
    "resets",
    type=PartName(),
    metavar="PART[:NAME]",
    multiple=True,
    help="First forget where this is, because it was moved: camera, laser or plane, with its name "
    "where there are several. Repeatable.",
)
automatic_option = click.option(
    "--automatic",
    is_flag=True,
    help="When something has moved and it is sure what, free it and go on without being asked.",
)
prefix_option = click.option(
    "--prefix",
    metavar="TEXT",
    default="",
    help="Put this before every id of CAPTURE, whose ids may have been used before.",
)


def named_parts(resets: Iterable[tuple[str, str]], cell: Cell | None) -> list[tuple[str, str]]:
    """Parts with the names that were left out; `DataError` where one is unknown or not clear."""
    found = []
    for part, name in resets:
        if cell is None:
            raise DataError(f"--reset {part}: there is no estimate yet, so nothing can be freed")
        names = list(getattr(cell, f"{part}s"))
        if not name and len(names) == 1:
            found.append((part, names[0]))
        elif name in names:
            found.append((part, name))
        else:
            wrong = f"there is no {part} {name!r}" if name else "say which"
            raise DataError(
                f"--reset {part}{':' if name else ''}{name}: {wrong}; there are "
                + ", ".join(f"{part}:{known}" for known in names)
            )
    return found


def stated_sigma(start: Calibration, noise: CaptureNoise) -> float | None:
    """Pixel sigma for spots of a capture whose noise is not that of the calibration."""
    before = start.inputs.options.sigma_px
    if before is None or noise.sigma_px is None or noise.sigma_px == before:
        return None
    return noise.sigma_px


def disagreements(
    options: CalibrationOptions, noise: CaptureNoise, known: Mapping[str, Any], path: Path
) -> list[str]:
    """What ``capture.yaml`` says other than the calibration that is continued, which counts."""
    names = [
        f"noise.{name}"
        for name, stated, used in (
            ("hand_translation_mm", noise.hand_sigma_m, options.hand_sigma_m),
            ("hand_rotation_deg", noise.hand_sigma_rad, options.hand_sigma_rad),
        )
        if stated not in (0.0, used)
    ]
    names += [f"known.{name}" for name, v in known.items() if options.known.get(name) != v]
    return [
        f"{path.name}: {name} is not what the calibration was made with, and does not count here"
        for name in names
    ]
