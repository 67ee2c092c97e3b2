"""Options of the commands that write hand poses: the robot's convention."""

from __future__ import annotations

import click

from lasercal_gtsam.cli.console import F
from lasercal_gtsam.cli.values import RotationName


def pose_options(function: F) -> F:
    """Add ``--rotation``, ``--transform`` and ``--length``; the defaults are those of a capture."""
    for option in (
        click.option(
            "--length",
            type=click.Choice(["mm", "m"]),
            default="mm",
            show_default=True,
            help="Unit of the positions.",
        ),
        click.option(
            "--transform",
            type=click.Choice(["T_base_hand", "T_hand_base"]),
            default="T_base_hand",
            show_default=True,
            help="Which way round the poses are written.",
        ),
        click.option(
            "--rotation",
            type=RotationName(),
            metavar="FORMAT",
            default="quat_wxyz",
            show_default=True,
            help="How the hand's rotation is written: quat_xyzw, matrix, kuka, fanuc, ur, ...",
        ),
    ):
        function = option(function)
    return function
