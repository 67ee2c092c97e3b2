"""Options of `lasercal calibrate` for a lens that another program has calibrated."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import warn
from lasercal_gtsam.cli.values import Assignment, Number
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.cell import Cell
    from lasercal_gtsam.formats.given_intrinsics import How
    from lasercal_gtsam.formats.intrinsics import GivenIntrinsics
    from lasercal_gtsam.observations import Observations
    from lasercal_gtsam.options import CalibrationOptions


@dataclass(frozen=True)
class GivenLens:
    """What was said on the command line.

    Attributes
    ----------
    files : ``[CAMERA=]FILE[@ENTRY]`` each
    how : what is done with them
    sigmas : of rows of the table
    """

    files: tuple[str, ...]
    how: How
    sigmas: Mapping[str, float]

    def load(self, observations: Observations) -> dict[str, GivenIntrinsics]:
        """Camera name to its lens; `DataError` where a file or a name is wrong."""
        from lasercal_gtsam.formats.intrinsics import load_intrinsics

        found: dict[str, GivenIntrinsics] = {}
        for text in self.files:
            camera, path, entry = _parts(text)
            if camera is None:
                if len(observations.cameras) > 1:
                    names = ", ".join(observations.cameras)
                    raise DataError(
                        f"--intrinsics {text}: there are cameras {names}; say whose lens it is: "
                        "CAMERA=FILE"
                    )
                camera = observations.cameras[0]
            if camera in found:
                raise DataError(f"--intrinsics: camera {camera!r} is given a lens twice")
            found[camera] = load_intrinsics(path, entry)
        return found

    def apply(
        self,
        observations: Observations,
        options: CalibrationOptions,
        start: Cell | None,
        stated: Mapping[str, Any],
    ) -> tuple[CalibrationOptions, Cell | None]:
        """Options and start with the lenses; ``stated`` (--known) wins over the files."""
        if not self.files:
            return options, start
        from lasercal_gtsam.formats.given_intrinsics import start_with_intrinsics, with_intrinsics

        given = self.load(observations)
        options, words = with_intrinsics(options, observations, given, self.how, self.sigmas)
        warn(words)
        if self.how == "start":
            return options, start_with_intrinsics(observations, options, given, start)
        return replace(options, known={**options.known, **stated}), start


def intrinsics_options(command: Callable[..., int]) -> Callable[..., int]:
    """Add the options to a command, which gets them as one argument ``lens``."""

    @click.option(
        "--intrinsics",
        "files",
        metavar="[CAMERA=]FILE",
        multiple=True,
        help="A lens from elsewhere: ROS camera_info, Kalibr camchain, OpenCV FileStorage, mrcal "
        ".cameramodel, or a calibration or export of lasercal. FILE@cam1 takes one of several in a "
        "file. Repeatable; wins over capture.yaml, --known over it.",
    )
    @click.option(
        "--intrinsics-as",
        "how",
        type=click.Choice(["known", "prior", "start"]),
        default="known",
        show_default=True,
        help="known: held. prior: estimated, with the file's sigmas (or --intrinsics-sigma) as "
        "priors. start: only where the search begins.",
    )
    @click.option(
        "--intrinsics-sigma",
        "sigmas",
        type=Assignment(),
        metavar="NAME=SIGMA",
        multiple=True,
        help="Sigma of a prior, for files that have none: fu, fv, u0, v0 in px, alpha_c, k1, k2, "
        "p1, p2. Repeatable.",
    )
    @functools.wraps(command)
    def wrapper(
        *args: Any,
        files: tuple[str, ...],
        how: How,
        sigmas: tuple[tuple[str, Number], ...],
        **kwargs: Any,
    ) -> int:
        if sigmas and how != "prior":
            raise click.UsageError("--intrinsics-sigma goes with --intrinsics-as prior.")
        if not files and (sigmas or how != "known"):
            raise click.UsageError("--intrinsics-as and --intrinsics-sigma need --intrinsics FILE.")
        return command(*args, lens=GivenLens(files, how, _checked(sigmas)), **kwargs)

    return wrapper


def _checked(sigmas: tuple[tuple[str, Number], ...]) -> dict[str, float]:
    from lasercal_gtsam.formats.given_intrinsics import ROWS

    found: dict[str, float] = {}
    for name, value in sigmas:
        if name not in ROWS or isinstance(value, tuple) or not value > 0:
            raise click.UsageError(
                f"--intrinsics-sigma: expected one of {', '.join(ROWS)} = a number above 0, got "
                f"{name}={value}"
            )
        found[name] = value
    return found


def _parts(text: str) -> tuple[str | None, str, str | None]:
    """Camera, file and entry of ``[CAMERA=]FILE[@ENTRY]``; a file of that very name comes first."""
    if Path(text).exists():
        return None, text, None
    camera, equals, rest = text.partition("=")
    name, path = (camera, rest) if equals else (None, text)
    if Path(path).exists():
        return name, path, None
    file, at, entry = path.rpartition("@")
    return (name, file, entry) if at else (name, path, None)
