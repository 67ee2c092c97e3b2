"""What all commands share: results on stdout, everything else on stderr, progress on terminals."""

from __future__ import annotations

import math
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

import click

Progress = Callable[[int, int], None]
F = TypeVar("F", bound=Callable[..., Any])

# between two lines about the progress where there is no terminal
_LINE_SECONDS = 60.0

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as one JSON document on stdout."
)


def seed_option(what: str, default: int = 0) -> Callable[[F], F]:
    """``--seed N``; ``what`` says what the seed decides."""
    return click.option(
        "--seed",
        metavar="N",
        type=click.IntRange(min=0),
        default=default,
        show_default=True,
        help=what,
    )


def warn(warnings: Iterable[str]) -> None:
    """Print each warning as a line on stderr."""
    for text in warnings:
        click.echo(f"Warning: {text}", err=True)


def print_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document on stdout."""
    from lasercal_gtsam.io.plain import plain, to_json

    click.echo(to_json(plain(document)))


def wrapped(text: str, indent: str = "", hanging: str | None = None) -> str:
    """Text filled to the terminal's width; as it is where stdout is no terminal (logs, grep)."""
    if not sys.stdout.isatty():
        return indent + text
    return textwrap.fill(
        text,
        width=max(40, min(shutil.get_terminal_size().columns, 100)),
        initial_indent=indent,
        subsequent_indent=indent if hanging is None else hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )


def bullets(lines: Sequence[str]) -> list[str]:
    """Return the lines indented below a heading, each wrapped with a hanging indent."""
    return [wrapped(line, "  ", "      ") for line in lines]


@contextmanager
def progress(label: str, seldom: bool = False) -> Iterator[Progress]:
    """Give a function (done, total) that draws a progress bar on stderr if that is a terminal.

    The bar, and what draws it, come with the first call: often there is nothing to wait for.
    Elsewhere (a log) it is silent, or with ``seldom`` writes a line a minute with the expected end.
    """
    with ExitStack() as stack:
        draw: Progress | None = None

        def show(done: int, total: int) -> None:
            nonlocal draw
            if draw is None:
                draw = _start_bar(label, stack)
            draw(done, total)

        if sys.stderr.isatty():
            yield show
        else:
            yield _seldom(label) if seldom else _be_silent


def _be_silent(done: int, total: int) -> None:
    pass


def _seldom(label: str, clock: Callable[[], float] = time.monotonic) -> Progress:
    """Write ``Runs: 120 of 1200, 9 min left`` to stderr, at most once a minute."""
    first: tuple[float, int] | None = None
    last = clock()

    def show(done: int, total: int) -> None:
        nonlocal first, last
        now = clock()
        if first is None:
            first = now, done
        if now - last < _LINE_SECONDS or done >= total:
            return
        last = now
        pace = (now - first[0]) / max(done - first[1], 1)
        minutes = math.ceil(pace * (total - done) / 60.0)
        click.echo(f"{label}: {done} of {total}, about {minutes} min left", err=True)

    return show


def _start_bar(label: str, stack: ExitStack) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = stack.enter_context(Bar(*columns, console=Console(stderr=True), transient=True))
    task = bar.add_task("", total=None)
    return lambda done, total: bar.update(task, completed=done, total=total)
