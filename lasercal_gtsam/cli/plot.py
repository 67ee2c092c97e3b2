"""`lasercal plot`: figures of a calibration for papers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from lasercal_gtsam.cli.console import warn
from lasercal_gtsam.cli.outputs import check_writable
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.plot import KINDS, SUFFIXES

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration

_ALL = "all"


@click.command(
    short_help="Draw figures of a calibration for papers.",
    epilog="Needs Matplotlib: the extra 'report'. In Python: calibration.plot.residuals() and so "
    "on, on axes of your own.",
)
@click.argument("calibration", type=click.Path(path_type=Path))
@click.argument("kind", type=click.Choice([*KINDS, _ALL]))
@click.option(
    "-o",
    "--output",
    "outputs",
    metavar="FILE",
    type=click.Path(path_type=Path),
    multiple=True,
    required=True,
    help="Where the figure goes: .png, .svg or .pdf. Give it several times for several formats. "
    "'all' puts the figure's name behind that of the file: fig.pdf becomes fig-residuals.pdf.",
)
def plot(calibration: Path, kind: str, outputs: tuple[Path, ...]) -> int:
    """Draw a figure of CALIBRATION (calibration.json).

    residuals, coverage: over each camera's picture (and on each plane); error-map: the expected
    error in millimetres on each plane; correlation: of the rows of the table; cell: in space.
    """
    for path in outputs:
        if path.suffix.lower() not in SUFFIXES:
            raise DataError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    kinds = KINDS if kind == _ALL else (kind,)
    targets = {
        name: [
            path.with_name(f"{path.stem}-{name}{path.suffix}") if kind == _ALL else path
            for path in outputs
        ]
        for name in kinds
    }
    for path in (path for paths in targets.values() for path in paths):
        check_writable(path)
    from lasercal_gtsam.io.calibration_file import load_calibration

    loaded = load_calibration(calibration)
    drawn = 0
    for name, paths in targets.items():
        try:
            _draw(loaded, name, paths)
        except DataError as error:
            if kind != _ALL:
                raise
            warn([str(error)])
        else:
            drawn += 1
    if not drawn:
        raise DataError(f"{calibration}: there is nothing to draw")
    return 0


def _draw(calibration: Calibration, name: str, paths: list[Path]) -> None:
    from lasercal_gtsam.plot.files import figure_of, save_figure

    figure = figure_of(calibration, name)
    for path in paths:
        save_figure(figure, path)
        click.echo(f"Saved {path}.")
