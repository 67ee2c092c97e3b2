"""What `lasercal import` was asked for, and whether it goes together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

if TYPE_CHECKING:
    from lasercal_gtsam.recordings.stops import StillLimits


@dataclass(frozen=True)
class ImportRequest:
    """The command line, option by option."""

    recording: tuple[Path, ...]
    output: Path | None
    listing: bool
    base: str | None
    hand: str | None
    pose_topic: str | None
    images: tuple[str, ...]
    poses: Path | None
    pose_format: Literal["tum", "kalibr"] | None
    transform: Literal["T_base_hand", "T_hand_base"] | None
    names: Literal["auto", "s", "ms", "us", "ns", "order"]
    plane: str | None
    planes: Path | None
    plane_topic: str | None
    laser_topic: str | None
    laser_on: bool
    every_picture: bool
    still_mm: float
    still_deg: float
    still_s: float
    max_gap: float
    image_offset: float
    stamps: Literal["header", "received"]
    dry_run: bool
    force: bool
    as_json: bool

    def check(self) -> None:
        """Raise `click.UsageError` for options that do not go together."""
        if self.listing:
            return
        problems = []
        if self.output is None and not self.dry_run:
            problems.append("give -o/--output, or --dry-run to see what would be taken")
        if sum(x is not None for x in (self.plane, self.planes, self.plane_topic)) != 1:
            problems.append(
                "which plane is worked on cannot be seen: give one of --plane, --planes and "
                "--plane-topic"
            )
        if self.laser_topic and self.laser_on:
            problems.append("give --laser-topic or --laser-on, not both")
        if self.poses is not None:
            if self.pose_format is None or self.transform is None:
                problems.append("--poses needs --pose-format and --transform; none is assumed")
            if len(self.recording) > 1:
                problems.append("--poses goes with one folder of pictures")
            of_bags = ("base", "hand", "pose_topic", "images", "plane_topic", "laser_topic")
            problems += [
                f"--{name.replace('_', '-')} is for bags, --poses for a folder of pictures"
                for name in of_bags
                if getattr(self, name)
            ]
        elif self.pose_topic is None and not (self.base and self.hand):
            problems.append(
                "give --base and --hand (frames; --list shows them) or --pose-topic for a bag, "
                "--poses for a folder of pictures"
            )
        if problems:
            raise click.UsageError("\n       ".join(problems))

    @property
    def offset_ns(self) -> int:
        """What is added to the pictures' stamps."""
        return round(self.image_offset * 1e9)

    @property
    def limits(self) -> StillLimits:
        """When the hand stands still."""
        from lasercal_gtsam.recordings.stops import StillLimits

        return StillLimits(
            move_m=self.still_mm * M_PER_MM,
            turn_rad=self.still_deg * RAD_PER_DEG,
            window_ns=max(round(self.still_s * 1e9), 1),
            max_gap_ns=max(round(self.max_gap * 1e9), 1),
        )
