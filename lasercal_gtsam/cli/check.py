"""`lasercal check`: what a capture can give, and whether it is read rightly, before calibrating."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import bullets, json_option, print_json, progress, wrapped
from lasercal_gtsam.cli.texts import count

if TYPE_CHECKING:
    from lasercal_gtsam.check.diagnosis import Diagnosis, Judged
    from lasercal_gtsam.check.examine import Examination
    from lasercal_gtsam.check.picture import Coverage
    from lasercal_gtsam.check.poses import PoseFacts
    from lasercal_gtsam.check.weakness import Weakness

_MOST_READINGS = 6
_MOST_DISTORTION = 2


@click.command(
    short_help="Check a capture's geometry and conventions before calibrating.",
    epilog="Exit status: 0 nothing speaks against calibrating; 1 wrong data, poses that cannot "
    "suffice, or numbers that mean something else than declared.",
)
@click.argument("capture", type=click.Path(path_type=Path))
@click.option(
    "--pictures",
    is_flag=True,
    help="Look for the spots in pictures, too; otherwise only spots in tables are used.",
)
@click.option(
    "--no-readings",
    is_flag=True,
    help="Leave out the other readings of the poses, which take some seconds (inverse transform, "
    "other angles, quaternion order, mirrored pictures).",
)
@json_option
def check(capture: Path, pictures: bool, no_readings: bool, as_json: bool) -> int:
    """Say what the hand poses of CAPTURE (capture.yaml, or its folder) can give, in plain words.

    Works with poses alone, before any picture is taken. Where there are spots, it also says whether
    the declared convention agrees with them, which combinations of unknowns they hardly determine,
    and which shots would help. Nothing is changed and nothing is saved.
    """
    from lasercal_gtsam.check.examine import examine

    found = examine(capture, pictures=pictures, readings=not no_readings, bar=progress)
    if as_json:
        print_json(_document(found))
    else:
        click.echo("\n".join(_report(found)))
    for line in "\n".join(found.problems).splitlines():
        click.echo(f"Error: {line}", err=True)
    return 1 if found.problems else 0


def _report(found: Examination) -> list[str]:
    lines = [f"{found.path}: {_counts(found.poses)}", *_pose_lines(found.poses)]
    lines += _section("Spots:", [_coverage_line(c, len(found.coverage)) for c in found.coverage])
    if found.diagnosis is not None:
        lines += _section("Readings of the poses:", found.reading)
        lines += [f"    {line}" for line in _readings(found.diagnosis)]
    if found.fit is not None:
        lines += _section("Calibration:", [found.fit])
    lines += _section("Weak:", _weak_lines(found.weak))
    lines += _section("Could be better:", found.poses.advice)
    lines += _section("Odd:", found.remarks)
    return [*lines, "", *map(wrapped, _verdict(found))]


def _counts(poses: PoseFacts) -> str:
    parts = [count(poses.rows, "shot")]
    for kind in ("plane", "camera", "laser"):
        shots = poses.counts[kind]
        if len(shots) > 1 or kind == "plane":
            each = ", ".join(f"{name}: {number}" for name, number in shots.items())
            parts.append(f"{count(len(shots), kind)} ({each})")
    return "; ".join(parts)


def _pose_lines(poses: PoseFacts) -> list[str]:
    turns = poses.turns
    first, second, third = turns.rms_deg
    x, y, z = poses.extent_mm
    lines = [
        f"{count(turns.distinct, 'hand orientation')}, turned by {first:.1f}, {second:.1f} and "
        f"{third:.1f} deg rms about three axes, up to {turns.largest_deg:.0f} deg from the middle "
        f"one; the turns about {turns.axes} of them are large enough to tell much",
        f"the hand moves within a box of {x:.0f} x {y:.0f} x {z:.0f} mm, up to "
        f"{poses.reach_mm:.0f} mm from the base",
    ]
    for plane in poses.planes:
        text = (
            f"plane {plane.plane}: {count(plane.rows, 'shot')}, "
            f"{count(plane.orientations, 'hand orientation')}"
        )
        if plane.groups:
            text += (
                f", {count(plane.groups, 'group')} of pure translations ({plane.in_groups} shots, "
                f"{plane.longest_mm:.0f} mm from the middle of a group)"
            )
        else:
            text += ", no groups of pure translations (none are needed, but they help the start)"
        lines.append(text)
    return _section("Hand poses:", lines)


def _coverage_line(spots: Coverage, cameras: int) -> str:
    who = f"camera {spots.camera!r}: " if cameras > 1 else ""
    return (
        f"{who}{count(spots.spots, 'spot')} over {100 * spots.span[0]:.0f} % of the picture's "
        f"width and {100 * spots.span[1]:.0f} % of its height, in {spots.fields} of its 12 fields; "
        f"the farthest is {100 * spots.reach:.0f} % of the way to a corner"
    )


def _readings(diagnosis: Diagnosis) -> list[str]:
    """A small table: reading, residual, spots that fit, verdict."""
    shown = [j for j in diagnosis.readings if j.stage != "screened"]
    shown = shown[:_MOST_READINGS]
    if diagnosis.declared not in shown:
        shown.append(diagnosis.declared)
    width = max(len(j.words) for j in shown)
    lines = [f"{'reading':{width}}  residual px  spots that fit"]
    for j in shown:
        residual = f"{j.residual_px:11.3g}" if j.residual_px < float("inf") else f"{'none':>11}"
        words = f"{j.words:{width}}  {residual}  {j.fitting:6d} of {diagnosis.n_spots}"
        lines.append(f"{words}{_remark(j, diagnosis)}")
    rest = len(diagnosis.readings) - len(shown)
    if rest:
        lines.append(f"and {count(rest, 'reading')} that fit worse")
    return lines


def _remark(judged: Judged, diagnosis: Diagnosis) -> str:
    words = ["declared"] if judged.declared else []
    if judged is diagnosis.best:
        words.append("best")
    if judged in diagnosis.alike:
        words.append("fits as well")
    if judged.wrong_side:
        words.append("camera behind a plane")
    return f"  ({', '.join(words)})" if words else ""


def _weak_lines(weak: Sequence[Weakness]) -> list[str]:
    lines = []
    geometry = [w for w in weak if not w.distortion]
    distortion = [w for w in weak if w.distortion]
    for weakness in geometry:
        lines.append(weakness.words)
        lines += [f"or: {cure.cause}; {cure.words}" for cure in weakness.cures[1:]]
        lines.append(f"changes like these hardly move a spot: {weakness.amounts}")
    for weakness in distortion[:_MOST_DISTORTION]:
        lines.append(f"only with the distortion free: {weakness.words}")
    if distortion:
        more = len(distortion) - _MOST_DISTORTION
        also = f"{count(more, 'more direction')} with the distortion free; " if more > 0 else ""
        lines.append(f"{also}calibrate with fewer terms (--distortion k1, or none) to avoid these")
    return lines


def _verdict(found: Examination) -> list[str]:
    if found.problems:
        return ["Calibrating this capture would not give an answer to trust; see the error."]
    lines = []
    if not found.spots:
        lines.append(
            "The hand poses are enough for a start."
            if not found.poses.advice
            else "The hand poses can suffice, but see what could be better."
        )
        if found.not_looked_at:
            lines.append(
                f"{count(found.not_looked_at, 'picture')} not looked at; with --pictures the spots "
                "are looked for, and conventions and geometry are judged by them."
            )
        else:
            lines.append("There are no spots yet; with them more can be said.")
        return lines
    if found.not_looked_at:
        lines.append(f"{count(found.not_looked_at, 'picture')} not looked at (see --pictures).")
    if any(not w.distortion for w in found.weak):
        lines.append("The geometry is weak: the shots named above would help.")
    else:
        lines.append("The geometry determines the cell.")
    return lines


def _section(heading: str, lines: Sequence[str]) -> list[str]:
    return [wrapped(heading), *bullets(lines)] if lines else []


def _document(found: Examination) -> dict[str, Any]:
    """What was found as plain data; the verdict in words comes last."""
    from lasercal_gtsam.io.plain import plain

    document: dict[str, Any] = {
        name: plain(getattr(found, name))
        for name in ("poses", "spots", "not_looked_at", "coverage", "diagnosis", "reading", "fit")
    }
    weak = [{**plain(w), "words": w.words} for w in found.weak]
    return {
        "capture": str(found.path),
        **document,
        "weak": weak,
        "problems": list(found.problems),
        "remarks": list(found.remarks),
        "verdict": " ".join(_verdict(found)),
    }
