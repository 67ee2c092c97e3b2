"""`lasercal import`: a bag, or pictures with a pose file, becomes a capture."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from lasercal_gtsam.cli.console import json_option, print_json, progress, warn
from lasercal_gtsam.cli.import_request import ImportRequest
from lasercal_gtsam.cli.imported import report_lines, show_bag, summary
from lasercal_gtsam.cli.outputs import capture_folder
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.recordings.bags import Bag
    from lasercal_gtsam.recordings.laser import LaserAt
    from lasercal_gtsam.recordings.motion import Motion
    from lasercal_gtsam.recordings.plan import Plan
    from lasercal_gtsam.recordings.planes import PlaneNames
    from lasercal_gtsam.recordings.sources import PictureSource

_POSITIVE = click.FloatRange(min=0, min_open=True)


@click.command(
    "import",
    short_help="Make a capture of a bag, or of pictures and a pose file.",
    epilog="Such as: lasercal import run.bag -o cell --base base_link --hand tool0 --plane table",
)
@click.argument("recording", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder of the capture.")
@click.option(
    "--list", "listing", is_flag=True, help="Show what is in the bag: topics, frames, times."
)
@click.option("--base", metavar="FRAME", help="Frame of the robot's base, such as base_link.")
@click.option(
    "--hand", metavar="FRAME", help="Frame that the laser is fixed to, such as tool0 or flange."
)
@click.option(
    "--pose-topic",
    metavar="TOPIC",
    help="Take the hand's poses from a PoseStamped, TransformStamped or Odometry topic, not /tf.",
)
@click.option(
    "--images",
    metavar="[CAMERA=]TOPIC",
    multiple=True,
    help="Image topic, raw or compressed; once for each camera. May be left out if there is one.",
)
@click.option("--poses", type=click.Path(path_type=Path), help="Pose file of a picture folder.")
@click.option(
    "--pose-format",
    type=click.Choice(["tum", "kalibr"]),
    help="tum: t[s] x y z qx qy qz qw; kalibr: t[ns],x,y,z,qw,qx,qy,qz; metres.",
)
@click.option(
    "--transform",
    type=click.Choice(["T_base_hand", "T_hand_base"]),
    help="What the pose file holds: the hand in the base, or the base in the hand.",
)
@click.option(
    "--names",
    type=click.Choice(["auto", "s", "ms", "us", "ns", "order"]),
    default="auto",
    show_default=True,
    help="Unit of the stamps that the pictures' names are; order: one for each pose.",
)
@click.option("--plane", metavar="NAME", help="All stops are on this plane.")
@click.option(
    "--planes",
    metavar="CSV",
    type=click.Path(path_type=Path),
    help="Table start_s,end_s,plane (seconds from the beginning) or start_stamp,end_stamp,plane.",
)
@click.option("--plane-topic", metavar="TOPIC", help="std_msgs/String topic that names the plane.")
@click.option(
    "--laser-topic",
    metavar="TOPIC",
    help="std_msgs/Bool topic, true while the laser is on; else it is seen in the pictures.",
)
@click.option("--laser-on", is_flag=True, help="The laser is on in every picture.")
@click.option(
    "--every-picture",
    is_flag=True,
    help="Every picture was taken at a standstill: do not look for stops.",
)
@click.option(
    "--still-mm",
    type=_POSITIVE,
    default=0.2,
    show_default=True,
    metavar="MM",
    help="Most that a hand moves which stands still.",
)
@click.option(
    "--still-deg",
    type=_POSITIVE,
    default=0.05,
    show_default=True,
    metavar="DEG",
    help="Most that it turns.",
)
@click.option(
    "--still-s",
    type=_POSITIVE,
    default=0.3,
    show_default=True,
    metavar="S",
    help="For how long it must stand still; half of it before and after each picture.",
)
@click.option(
    "--max-gap",
    type=_POSITIVE,
    default=0.25,
    show_default=True,
    metavar="S",
    help="Poses farther apart than this say nothing about the time between them.",
)
@click.option(
    "--image-offset",
    type=float,
    default=0.0,
    show_default=True,
    metavar="S",
    help="Added to the pictures' stamps, where camera and robot are on different clocks.",
)
@click.option(
    "--stamps",
    type=click.Choice(["header", "received"]),
    default="header",
    show_default=True,
    help="Time of a message: its own stamp, or when the recorder received it.",
)
@click.option("--dry-run", is_flag=True, help="Say what would be taken, and write nothing.")
@click.option("--force", is_flag=True, help="Replace a capture that is there; other files stay.")
@json_option
def import_recording(**given: Any) -> None:
    """Make a capture of a recording: pictures where the hand stands still, with its poses.

    RECORDING is a ROS 1 or ROS 2 bag (.bag, .mcap, .db3 or a bag's folder; several for a bag that
    was split), or a folder of pictures named by their stamps, with --poses.
    """
    ask = ImportRequest(**given)
    ask.check()
    if ask.listing:
        _check_is_bag(ask.recording)
        show_bag(ask.recording, ask.stamps, ask.as_json)
        return
    with ExitStack() as stack:
        folder = None
        if ask.output is not None and not ask.dry_run:  # refused before the work, not after it
            folder = stack.enter_context(capture_folder(ask.output, ask.force))
        recorded = stack.enter_context(_opened(ask))
        plan = _plan(ask, recorded)
        if folder is not None:
            _write(folder, recorded, plan)
    written = None if ask.dry_run else ask.output
    warn(plan.notes)
    if ask.as_json:
        print_json(summary(plan, written, recorded.about))
    else:
        click.echo("\n".join(report_lines(plan, written, recorded.about)))


@dataclass(frozen=True)
class _Recorded:
    """What the recording gives."""

    motion: Motion
    sources: tuple[PictureSource, ...]
    planes: PlaneNames
    laser: LaserAt | Literal["see", "on"]
    about: dict[str, Any]
    notes: tuple[str, ...]


@contextmanager
def _opened(ask: ImportRequest) -> Iterator[_Recorded]:
    if ask.poses is not None:
        yield _from_folder(ask, ask.poses)
        return
    from lasercal_gtsam.recordings.bags import open_bag

    _check_is_bag(ask.recording)
    with open_bag(*ask.recording, clock=ask.stamps) as bag:
        yield _from_bag(ask, bag)


def _check_is_bag(paths: Sequence[Path]) -> None:
    from lasercal_gtsam.recordings.bags import bag_files
    from lasercal_gtsam.recordings.picture_folder import picture_files

    for path in paths:
        if path.is_dir() and bag_files(path) is None and picture_files(path):
            raise DataError(
                f"{path}: this is a folder of pictures: give their poses with --poses, "
                "--pose-format and --transform. Pictures named by pose id need no import: write "
                "a capture.yaml with images: {id}.png beside the table of poses"
            )


def _from_folder(ask: ImportRequest, poses: Path) -> _Recorded:
    from lasercal_gtsam.recordings.picture_folder import open_folder
    from lasercal_gtsam.recordings.pose_files import read_pose_file

    assert ask.pose_format is not None
    assert ask.transform is not None
    motion = read_pose_file(poses, ask.pose_format, ask.transform)
    source = open_folder(
        ask.recording[0],
        naming=ask.names,
        pose_stamps=motion.moving[0].stamps,
        offset=ask.offset_ns,
    )
    about = {
        "pictures": str(ask.recording[0]),
        "poses": str(poses),
        "pose_format": ask.pose_format,
        "transform": ask.transform,
        "names": ask.names,
    }
    laser: Literal["see", "on"] = "on" if ask.laser_on else "see"
    return _Recorded(motion, (source,), _planes(ask, None, motion, [source]), laser, about, ())


def _from_bag(ask: ImportRequest, bag: Bag) -> _Recorded:
    from lasercal_gtsam.recordings.bag_notes import clock_notes

    if ask.pose_topic is not None:
        motion = bag.pose_motion(ask.pose_topic, ask.base, ask.hand)
    else:
        motion = bag.hand_motion(str(ask.base), str(ask.hand))
    topics = _image_topics(ask, bag)
    sources = tuple(bag.pictures(topic, name, ask.offset_ns) for name, topic in topics.items())
    about: dict[str, Any] = {
        "bags": [str(path) for path in ask.recording],
        "base": motion.base,
        "hand": motion.hand,
        "poses": ask.pose_topic or "tf",
        "images": topics,
        "stamps": ask.stamps,
        "image_offset_s": ask.image_offset,
        "camera_info": {
            name: info for name, topic in topics.items() if (info := bag.camera_info(topic))
        },
    }
    return _Recorded(
        motion,
        sources,
        _planes(ask, bag, motion, sources),
        _laser(ask, bag),
        about,
        (
            *clock_notes(bag.lags, list(topics.values())),
            *(note for source in sources for note in source.notes),
        ),
    )


def _image_topics(ask: ImportRequest, bag: Bag) -> dict[str, str]:
    """Camera name to topic."""
    from lasercal_gtsam.recordings.bags import IMAGE_TYPES

    if not ask.images:
        found = bag.of_types(IMAGE_TYPES)
        if len(found) != 1:
            which = ", ".join(found) if found else "none"
            raise DataError(f"--images: give the image topic; {bag.name} has {which}")
        return {"camera": found[0]}
    topics: dict[str, str] = {}
    for text in ask.images:
        name, equals, topic = text.rpartition("=")
        name = name if equals else "camera"
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise DataError(
                f"--images: the camera's name {name!r} may hold letters, digits, - and _ only"
            )
        if name in topics:
            raise DataError(
                f"--images: two topics for camera {name!r}; several cameras are written "
                "--images left=/left/image_raw --images right=/right/image_raw"
            )
        topics[name] = topic
    return topics


def _planes(
    ask: ImportRequest, bag: Bag | None, motion: Motion, sources: Sequence[PictureSource]
) -> PlaneNames:
    from lasercal_gtsam.recordings.plan import origin_of
    from lasercal_gtsam.recordings.planes import LatchedPlanes, OnePlane, read_plane_intervals

    if ask.plane is not None:
        return OnePlane(ask.plane)
    if ask.planes is not None:
        return read_plane_intervals(ask.planes, origin_of(motion, sources))
    assert bag is not None
    return LatchedPlanes(*bag.latched(str(ask.plane_topic), "String"))


def _laser(ask: ImportRequest, bag: Bag) -> LaserAt | Literal["see", "on"]:
    if ask.laser_topic is None:
        return "on" if ask.laser_on else "see"
    from lasercal_gtsam.recordings.laser import latched_laser

    return latched_laser(*bag.latched(ask.laser_topic, "Bool"))


def _plan(ask: ImportRequest, recorded: _Recorded) -> Plan:
    from lasercal_gtsam.recordings.plan import plan_capture

    with progress("Looking at stops") as show:
        plan = plan_capture(
            recorded.motion,
            recorded.sources,
            recorded.planes,
            laser=recorded.laser,
            limits=ask.limits,
            every_picture=ask.every_picture or ask.names == "order",
            progress=show,
        )
    return replace(plan, notes=(*recorded.notes, *plan.notes))


def _write(folder: Path, recorded: _Recorded, plan: Plan) -> None:
    from lasercal_gtsam.recordings.write import write_recording

    with progress("Writing pictures") as show:
        write_recording(folder, plan, recorded.sources, origin=recorded.about, progress=show)
