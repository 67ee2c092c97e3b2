"""`lasercal export`: a calibration into the files of other programs."""

from __future__ import annotations

import textwrap
from pathlib import Path

import click

from lasercal_gtsam.cli.console import json_option, print_json, warn
from lasercal_gtsam.cli.outputs import check_writable
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.registry import FORMATS

_STDOUT = "-"
_INDENT = " " * 21


def _list_of_formats() -> str:
    """Paragraph of the help that is not to be filled: each format, what it is and holds."""
    lines = ["\b", "Formats:"]
    for form in FORMATS.values():
        lines.append(f"  {form.name:<16} {form.summary}")
        lines += textwrap.wrap(form.holds, 78, initial_indent=_INDENT, subsequent_indent=_INDENT)
    return "\n".join(lines)


@click.command(
    short_help="Write a calibration for ROS, URDF, OpenCV, GTSAM and more.",
    epilog=_list_of_formats(),
)
@click.argument("calibration", type=click.Path(path_type=Path))
@click.argument("format", type=click.Choice(list(FORMATS)), metavar="FORMAT")
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    help="Where to write it; - for standard output.  [default: beside CALIBRATION, named after it, "
    "the camera and the format]",
)
@click.option("--camera", metavar="NAME", help="Which camera, where there are several.")
@click.option(
    "--parent",
    metavar="FRAME",
    default="base",
    show_default=True,
    help="Name of the robot base's frame: of the base that the hand poses refer to. In ROS that "
    "may be 'base' while 'base_link' is turned against it.",
)
@click.option(
    "--child",
    metavar="FRAME",
    help="Name of the camera's optical frame (z forward, x right, y down).  [default: "
    "<camera>_optical_frame]",
)
@click.option(
    "--skew",
    type=click.Choice(["refuse", "refit"]),
    default="refuse",
    show_default=True,
    help="What is done where the format has no place for a skew that is not zero within its sigma; "
    "refit calibrates again with it held at 0, in any format, so that files belong together.",
)
@click.option("--force", is_flag=True, help="Write over a file that is there.")
@click.option(
    "--keep-unconverged",
    is_flag=True,
    help="Export also an answer that cannot be trusted.",
)
@json_option
def export(
    calibration: Path,
    format: str,
    output: str | None,
    camera: str | None,
    parent: str,
    child: str | None,
    skew: str,
    force: bool,
    keep_unconverged: bool,
    as_json: bool,
) -> int:
    """Write CALIBRATION (calibration.json) as a file of another program.

    Metres, radians and pixels; pixel (0, 0) is the centre of the top-left pixel in all formats.
    What is written is read back by the format's own rules first, and compared.
    """
    from lasercal_gtsam.formats.export import export as write_file
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.io.files import sha256_of

    if as_json and output == _STDOUT:
        raise click.UsageError("--json and -o - both write to standard output; leave one out.")
    form = FORMATS[format]
    loaded = load_calibration(calibration)
    target = None
    if output != _STDOUT:
        which = camera if form.of == "camera" or camera else None
        if which is None and form.of == "camera" and len(loaded.cell.cameras) == 1:
            which = next(iter(loaded.cell.cameras))
        words = [calibration.stem, *([which] if which else []), form.name]
        target = Path(output) if output else calibration.parent / ("-".join(words) + form.ending)
        check_writable(target)
        if target.exists() and not force:
            raise DataError(f"{target}: is there already; --force writes over it")
    done = write_file(
        loaded,
        format,
        target,
        camera=camera,
        parent=parent,
        child=child,
        skew="refit" if skew == "refit" else "refuse",
        keep_unconverged=keep_unconverged,
        origin=f"{calibration.name}, SHA-256 {sha256_of(calibration)}",
    )
    warn(done.notes)
    if as_json:
        document = {"format": done.format, "path": str(done.path), "notes": list(done.notes)}
        print_json({**document, "bytes": len(done.content)})
    elif target is None:
        click.echo(done.content, nl=False)
    else:
        click.echo(f"Wrote {target}: {form.summary}.")
        click.echo(f"It holds: {form.holds}.")
    return 0
