"""`lasercal plan`: where to drive the hand for the best calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from lasercal_gtsam.cli.console import json_option, print_json, seed_option
from lasercal_gtsam.cli.outputs import is_of
from lasercal_gtsam.cli.pose_options import pose_options
from lasercal_gtsam.cli.texts import count
from lasercal_gtsam.cli.values import Names, Numbers
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.units import DEG_PER_RAD, M_PER_MM, MM_PER_M, RAD_PER_DEG

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.plan import Limits, Plan


@click.command(
    short_help="Propose hand poses for a cell that is known roughly.",
    epilog="Drive to each pose, save its picture as images/ID.png; FOLDER is then a capture.",
)
@click.argument("cell", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="Write poses.csv and a capture.yaml that waits for the pictures into this new folder.",
)
@click.option(
    "-n",
    "--count",
    "number",
    metavar="N",
    type=click.IntRange(min=1),
    help="How many poses.  [default: 40; with --next 1]",
)
@click.option(
    "--next",
    "go_on",
    is_flag=True,
    help="Go on from the spots that CELL, a calibration.json, has already.",
)
@click.option(
    "--procedure",
    "groups",
    metavar="N",
    type=click.IntRange(min=1),
    help="Plan the paper's way instead: N groups of ten translations on each plane.",
)
@click.option("--camera", metavar="NAME", help="Where the cell has several.")
@click.option("--laser", metavar="NAME", help="Where the cell has several.")
@click.option(
    "--planes",
    type=Names(),
    metavar="A,B,...",
    help="Names of the planes to point at, and whose error counts.  [default: all]",
)
@click.option(
    "--beam-mm",
    type=Numbers(2),
    metavar="MIN,MAX",
    help="Length of the beam.  [default: 80,160; of a calibration: as it was]",
)
@click.option(
    "--cone-deg",
    metavar="X",
    type=click.FloatRange(0, 90, max_open=True),
    help="How far the beam may lean from a plane's normal.  [default: 40]",
)
@click.option(
    "--roll-deg",
    metavar="X",
    type=click.FloatRange(0, 180),
    help="How far the hand may turn about the beam, either way.  [default: 40]",
)
@click.option(
    "--margin-px",
    metavar="X",
    type=click.FloatRange(min=0),
    help="How far spots stay away from the picture's edge; more for a cell known only roughly.  "
    "[default: 12]",
)
@click.option(
    "--box-mm",
    type=Numbers(6),
    metavar="X0,Y0,Z0,X1,Y1,Z1",
    help="The hand stays in this box, base frame.",
)
@click.option(
    "--reach-mm",
    type=Numbers(2),
    metavar="MIN,MAX",
    help="Distance of the hand from the base's origin.",
)
@click.option(
    "--clearance-mm",
    metavar="X",
    type=click.FloatRange(min=0),
    help="Least distance of the hand from the plane it points at.",
)
@click.option(
    "--distortion",
    type=click.Choice(["all", "none"]),
    help="Whether the lens distortion will be estimated.  [default: all; with --next as it was]",
)
@click.option(
    "--sigma-px",
    metavar="X",
    type=click.FloatRange(min=0, min_open=True),
    help="Pixel noise that the promise assumes.  [default: 1; with --next the calibration's own]",
)
@seed_option("The same seed gives the same plan.")
@pose_options
@json_option
def plan(
    cell: Path,
    output: Path | None,
    number: int | None,
    go_on: bool,
    groups: int | None,
    camera: str | None,
    laser: str | None,
    planes: tuple[str, ...] | None,
    beam_mm: tuple[float, ...] | None,
    cone_deg: float | None,
    roll_deg: float | None,
    margin_px: float | None,
    box_mm: tuple[float, ...] | None,
    reach_mm: tuple[float, ...] | None,
    clearance_mm: float | None,
    distortion: str | None,
    sigma_px: float | None,
    seed: int,
    rotation: str,
    transform: Literal["T_base_hand", "T_hand_base"],
    length: Literal["mm", "m"],
    as_json: bool,
) -> None:
    """Pick the hand poses that leave the least millimetre error on the working planes.

    CELL is known roughly: a cell.json from drawings, or an earlier calibration.json. Every spot is
    in the camera's view and every pose within the limits; it is not known what is in the way.
    """
    if go_on and groups is not None:
        raise click.UsageError("--procedure and --next are two ways to plan; give one")
    if groups is not None and number is not None:
        raise click.UsageError("--procedure plans ten poses for each group; leave -n out")
    if go_on and (distortion is not None or sigma_px is not None):
        raise click.UsageError(
            "--next takes the distortion terms and the pixel noise from the calibration; leave "
            "--distortion and --sigma-px out"
        )
    from lasercal_gtsam.plan import next_poses, procedure
    from lasercal_gtsam.plan import plan as make

    rough, earlier = _read(cell)
    limits = _limits(
        earlier, beam_mm, cone_deg, roll_deg, margin_px, box_mm, reach_mm, clearance_mm
    )
    names: dict[str, Any] = {
        "camera": camera,
        "laser": laser,
        "planes": planes,
        "limits": limits,
        "seed": seed,
    }
    if go_on:
        if earlier is None:
            raise DataError(f"{cell}: --next goes on from a calibration.json, this is only a cell")
        made = next_poses(earlier, 1 if number is None else number, **names)
    else:
        names |= {
            "distortion": distortion != "none",
            "sigma_px": 1.0 if sigma_px is None else sigma_px,
        }
        if groups is not None:
            made = procedure(rough, groups, **names)
        else:
            made = make(rough, 40 if number is None else number, **names)
    if output is not None:
        prefix = "n" if go_on else "p"
        made.save(output, rotation=rotation, transform=transform, length=length, prefix=prefix)
    if as_json:
        print_json(_document(made, output))
    else:
        click.echo("\n".join(_lines(made, output, rotation, transform, length)))


def _read(path: Path) -> tuple[Cell, Calibration | None]:
    from lasercal_gtsam.io.calibration_file import FORMAT, load_calibration
    from lasercal_gtsam.io.cell_file import load_cell

    if is_of(path, FORMAT):
        calibration = load_calibration(path)
        return calibration.cell, calibration
    return load_cell(path), None


def _limits(
    earlier: Calibration | None,
    beam_mm: tuple[float, ...] | None,
    cone_deg: float | None,
    roll_deg: float | None,
    margin_px: float | None,
    box_mm: tuple[float, ...] | None,
    reach_mm: tuple[float, ...] | None,
    clearance_mm: float | None,
) -> Limits:
    from lasercal_gtsam.plan import Limits, limits_of

    base = Limits() if earlier is None else limits_of(earlier)
    given: dict[str, Any] = {}
    if beam_mm is not None:
        given["beam_length"] = tuple(x * M_PER_MM for x in beam_mm)
    if cone_deg is not None:
        given["cone"] = cone_deg * RAD_PER_DEG
    if roll_deg is not None:
        given["roll"] = roll_deg * RAD_PER_DEG
    if margin_px is not None:
        given["margin_px"] = margin_px
    if box_mm is not None:
        metres = tuple(x * M_PER_MM for x in box_mm)
        given["box"] = (metres[:3], metres[3:])
    if reach_mm is not None:
        given["reach"] = tuple(x * M_PER_MM for x in reach_mm)
    if clearance_mm is not None:
        given["clearance"] = clearance_mm * M_PER_MM
    return replace(base, **given)


def _lines(
    made: Plan, output: Path | None, rotation: str, transform: str, length: str
) -> list[str]:
    import numpy as np

    names, counts = np.unique(made.plane, return_counts=True)
    shares = ", ".join(f"{c} on plane {n}" for n, c in zip(names, counts, strict=True))
    lines = [f"{count(len(made), 'pose')}: {shares}."]
    for name, after in made.after.items():
        before = "" if made.before is None else f"{made.before[name] * MM_PER_M:.3g} -> "
        lines.append(
            f"  plane {name}: expected error of a located point {before}{after * MM_PER_M:.3g} mm "
            f"(1 sigma, rms over what the camera sees)"
        )
    if output is not None:
        lines.append(
            f"Saved {output / 'poses.csv'} ({transform}, {length}, {rotation}). Drive there, save "
            f"each picture as images/ID.png, then: lasercal calibrate {output}"
        )
        return lines
    lines.append("")
    lines.append("hand in base: x, y, z (mm), rotation vector (deg); spot expected at u, v (px)")
    from lasercal_gtsam.rotations import rotation_log

    for T, plane, uv in zip(made.T_base_hand, made.plane, made.uv, strict=True):
        x = T[:3, 3] * MM_PER_M
        w = rotation_log(T[:3, :3]) * DEG_PER_RAD
        lines.append(
            f"  plane {plane}: {x[0]:9.2f} {x[1]:9.2f} {x[2]:9.2f}  "
            f"{w[0]:8.3f} {w[1]:8.3f} {w[2]:8.3f}   {uv[0]:6.1f} {uv[1]:6.1f}"
        )
    return lines


def _document(made: Plan, output: Path | None) -> dict[str, Any]:
    return {
        "saved": None if output is None else str(output),
        "camera": made.camera,
        "laser": made.laser,
        "sigma_px": made.sigma_px,
        "error_before_m": made.before,
        "error_after_m": made.after,
        "poses": [
            {"plane": str(plane), "T_base_hand": T, "uv_px": uv}
            for T, plane, uv in zip(made.T_base_hand, made.plane, made.uv, strict=True)
        ],
    }
