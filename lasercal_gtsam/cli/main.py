"""Entry point of `lasercal`: the group of commands, and what an exit status means.

0 done; 1 something is wrong with the data or the answer, said in one line each on stderr; 2 wrong
usage (click's own); 130 interrupted. Anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import atexit
import gc
import io
import sys
from collections.abc import Sequence

import click

from lasercal_gtsam import __version__
from lasercal_gtsam.cli.calibrate import calibrate
from lasercal_gtsam.cli.check import check
from lasercal_gtsam.cli.check_sigma import check_sigma
from lasercal_gtsam.cli.compare import compare
from lasercal_gtsam.cli.demo import demo
from lasercal_gtsam.cli.detect import detect
from lasercal_gtsam.cli.export import export
from lasercal_gtsam.cli.history import history
from lasercal_gtsam.cli.importing import import_recording
from lasercal_gtsam.cli.judge import judge
from lasercal_gtsam.cli.plan import plan
from lasercal_gtsam.cli.plot import plot
from lasercal_gtsam.cli.report import report
from lasercal_gtsam.cli.simulate import simulate
from lasercal_gtsam.cli.study import study
from lasercal_gtsam.cli.update import update
from lasercal_gtsam.cli.watch import watch
from lasercal_gtsam.errors import LasercalError

FAILED, INTERRUPTED = 1, 130
_GC_THRESHOLD = 100_000  # objects made before a collection; Python's own 700 is for long lives


@click.group(
    name="lasercal",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="'lasercal demo' shows the whole way on simulated pictures; begin with it. "
    "'lasercal COMMAND -h' explains a command.",
)
@click.version_option(__version__, prog_name="lasercal", message="%(prog)s %(version)s")
def cli() -> None:
    """Calibrate a robot cell from pictures of a laser spot and hand poses.

    Camera intrinsics, the camera in the robot base, the beam in the hand and every working plane,
    each number with its sigma.
    """


for _command in (
    calibrate,
    check,
    check_sigma,
    judge,
    compare,
    report,
    plot,
    import_recording,
    detect,
    update,
    watch,
    history,
    export,
    simulate,
    plan,
    study,
    demo,
):
    cli.add_command(_command)


def main(args: Sequence[str] | None = None) -> int:
    """Run `lasercal` and return its exit status; a user's error becomes a line on stderr."""
    if args is None:
        _expect_a_short_life()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # a name that the terminal cannot show must not end a calibration
            stream.reconfigure(errors="backslashreplace")
    try:
        status = cli.main(args=args, prog_name="lasercal", standalone_mode=False)
    except click.ClickException as error:
        told = io.StringIO()
        error.show(told)
        for line in told.getvalue().removesuffix("\n").split("\n"):
            click.echo(_visible(line), err=True)
        return error.exit_code
    except click.Abort:
        click.echo("Interrupted: nothing was saved half written.", err=True)
        return INTERRUPTED
    except LasercalError as error:
        for line in str(error).split("\n"):
            click.echo(f"Error: {_visible(line)}", err=True)
        return FAILED
    except OSError as error:  # a full disk, a terminal that is gone
        click.echo(f"Error: {_visible(str(error))}", err=True)
        return FAILED
    return status if isinstance(status, int) else 0


def _visible(text: str) -> str:
    """Text with escapes for what a terminal would obey instead of show."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _expect_a_short_life() -> None:
    """Spare the garbage collector what the imports make: it lives to the end (0.2 s of 1.2 s)."""
    gc.set_threshold(_GC_THRESHOLD)
    atexit.register(gc.freeze)
