"""What `lasercal import` says: what is in a bag, and what was taken from a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from lasercal_gtsam.cli.console import bullets, print_json, wrapped
from lasercal_gtsam.cli.texts import count

if TYPE_CHECKING:
    from lasercal_gtsam.recordings.bags import Bag
    from lasercal_gtsam.recordings.plan import Plan

_MOST_LINES = 20


def report_lines(plan: Plan, written: Path | None, about: Mapping[str, Any]) -> list[str]:
    """What became of the stops, for people; ``written`` is None in a dry run."""
    shots = plan.shots
    planes = sorted({shot.plane for shot in shots})
    pairs = sum(shot.off is not None for shot in shots)
    lines = [
        wrapped(_sources(about)),
        wrapped(
            f"{count(len(plan.stops), 'stop')}, {count(len(shots), 'row')} on "
            f"{count(len(planes), 'plane')} ({', '.join(planes)}); {pairs} with a laser-off picture"
        ),
    ]
    if plan.left_out:
        lines.append(f"Left out ({len(plan.left_out)}):")
        lines += bullets(plan.left_out[:_MOST_LINES])
        if len(plan.left_out) > _MOST_LINES:
            lines.append(f"  ... and {len(plan.left_out) - _MOST_LINES} more")
    if written is not None:
        return [*lines, f"{written}: written. Next: lasercal detect {written}"]
    lines.append("Nothing was written (--dry-run). The rows would be:")
    return lines + [
        f"  {shot.id}  {(shot.stamp - plan.origin) * 1e-9:9.3f} s  plane {shot.plane}  "
        f"{count(shot.n_pictures, 'picture')}"
        for shot in shots
    ]


def _sources(about: Mapping[str, Any]) -> str:
    if "bags" not in about:
        return f"Pictures of {about['pictures']}, hand poses of {about['poses']}"
    topics = about["images"]
    cameras = [f"{topic} ({name})" if len(topics) > 1 else topic for name, topic in topics.items()]
    return (
        f"Pictures of {', '.join(cameras)}, hand poses {about['base']} <- {about['hand']} of "
        f"{about['poses']}"
    )


def summary(plan: Plan, written: Path | None, about: Mapping[str, Any]) -> dict[str, Any]:
    """The same for machines."""
    from lasercal_gtsam.io.capture import CAPTURE_FILE

    return {
        "capture": None if written is None else str(written / CAPTURE_FILE),
        **about,
        "first_stamp_ns": plan.origin,
        "stops": len(plan.stops),
        "rows": plan.shots,
        "left_out": plan.left_out,
        "notes": plan.notes,
    }


def show_bag(paths: Sequence[Path], clock: Literal["header", "received"], as_json: bool) -> None:
    """Print what is in a bag: topics, cameras, frames."""
    from lasercal_gtsam.recordings.bags import open_bag

    with open_bag(*paths, clock=clock) as bag:
        if as_json:
            print_json(
                {
                    "start_ns": bag.start,
                    "end_ns": bag.end,
                    "topics": list(bag.topics.values()),
                    "frames": bag.transforms().frames,
                    "camera_info": bag.camera_infos(),
                }
            )
        else:
            click.echo("\n".join(_bag_lines(bag)))


def _bag_lines(bag: Bag) -> list[str]:
    from lasercal_gtsam.recordings.stamps import duration_text, seconds_text

    tree = bag.transforms().lines()
    return [
        f"{bag.name}: {duration_text(bag.end - bag.start)}, received from "
        f"{seconds_text(bag.start)} s on",
        "Topics:",
        *(f"  {t.name}  {t.kind}  {count(t.count, 'message')}" for t in bag.topics.values()),
        *(
            f"Camera of {image}: {info.width} x {info.height}, {info.distortion_model}, "
            f"K {list(info.K)}, D {list(info.D)}"
            for image, info in bag.camera_infos().items()
        ),
        "Frames:" if tree else "Frames: none (no /tf)",
        *(f"  {line}" for line in tree),
    ]
