"""`lasercal compare`: what differs between two calibrations, and whether noise explains it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from lasercal_gtsam.cli.console import bullets, json_option, print_json, wrapped
from lasercal_gtsam.cli.report import page_target

if TYPE_CHECKING:
    from lasercal_gtsam.comparison.result import (
        Comparison,
        InputsChange,
        PartChange,
        PixelMap,
        PlaneMap,
        RowChange,
    )

_PAGE = "compare.html"
_MOST_IDS = 8
_HASH = 12


@click.command(
    short_help="Say what differs between two calibrations.",
    epilog="Exit status: 0 compared, whatever the outcome (--json has it for scripts); 1 not "
    "readable, or not writable.",
)
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Also write a page (HTML) with maps in pixels and millimetres.",
)
@json_option
def compare(a: Path, b: Path, output: Path | None, as_json: bool) -> None:
    """Compare calibration B with calibration A (two calibration.json).

    Every parameter in sigmas of the difference, B minus A; every camera, lens, beam and plane as a
    whole; pixels over the picture and millimetres on each plane; what changed in the inputs.
    """
    target = None if output is None else page_target(output, _PAGE)
    from lasercal_gtsam.comparison import compare as compared
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.io.origin import Origin

    found = compared(
        load_calibration(a), load_calibration(b), origins=(Origin.of_file(a), Origin.of_file(b))
    )
    names = (str(a), str(b))
    if target is not None:
        from lasercal_gtsam.report.comparison import write_page

        write_page(found, target, names)
    if as_json:
        from lasercal_gtsam.report.comparison import comparison_document

        print_json(comparison_document(found, names))
        return
    click.echo("\n".join(report(found)))
    if target is not None:
        click.echo(f"Saved {target}.")


def report(found: Comparison) -> list[str]:
    """Build the lines that are printed."""
    lines = [wrapped(found.words), wrapped(f"Next: {found.next_action}"), wrapped(found.basis)]
    for name, parts in (("A", found.only_a), ("B", found.only_b)):
        if parts:
            lines.append(wrapped(f"Only in {name}: {', '.join(parts)}."))
    if found.notes:
        lines += ["Remarks:", *bullets(found.notes)]

    def section(heading: str, rows: list[tuple[str, ...]]) -> None:
        from lasercal_gtsam.calibration import text_table

        if len(rows) > 1:
            table = text_table([*rows, ("",) * len(rows[0])]).splitlines()[:-2]
            lines.extend(["", wrapped(heading), *(f"  {line.rstrip()}" for line in table)])

    section("Parts (chance: corrected for their number):", _part_rows(found.parts))
    section("Rows of the table, B minus A:", _table_rows(found.rows))
    section(
        "Millimetres between where they locate the same pixel on a plane, among A's spots:",
        _plane_rows(found.plane_maps),
    )
    section(
        "Pixels between where they see the same points of a plane, among the spots:",
        _pixel_rows(found.pixel_maps),
    )
    return [*lines, "", *_input_lines(found.inputs)]


def _part_rows(parts: tuple[PartChange, ...]) -> list[tuple[str, ...]]:
    from lasercal_gtsam.calibration import measured

    rows: list[tuple[str, ...]] = [
        ("part", "shift (mm)", "turn (deg)", "distance", "unknowns", "chance", "")
    ]
    for part in parts:
        lens = part.kind == "lens"
        rows.append(
            (
                part.label,
                "" if lens else measured(part.shift_mm, part.shift_sigma_mm),
                "" if lens else measured(part.turn_deg, part.turn_sigma_deg),
                f"{part.distance:.3g}" if part.unknowns else "",
                str(part.unknowns) if part.unknowns else "held",
                _chance(part.corrected),
                f"held at other values: {', '.join(part.held)}" if part.held else "",
            )
        )
    return rows


def _table_rows(rows: tuple[RowChange, ...]) -> list[tuple[str, ...]]:
    from lasercal_gtsam.calibration import plain_number, sigma_decimals
    from lasercal_gtsam.report.comparison import sigma_text

    table: list[tuple[str, ...]] = [("", "A", "B", "B - A", "sigma", "in sigmas", "Unit")]
    for row in rows:
        decimals = sigma_decimals(row.sigma)
        table.append(
            (
                row.name,
                *(plain_number(x, decimals) for x in (row.a, row.b, row.difference)),
                sigma_text(row, decimals),
                f"{row.sigmas:+.1f}" if row.sigma > 0 else "",
                row.unit,
            )
        )
    return table


def _plane_rows(maps: tuple[PlaneMap, ...]) -> list[tuple[str, ...]]:
    return [
        ("plane", "camera", "median", "by noise", "largest", "at (x, y)"),
        *(
            (
                one.plane,
                one.camera,
                f"{one.median_mm:.2g}",
                _number(one.expected_median_mm),
                f"{one.largest_mm:.2g}",
                f"{one.largest_at_mm[0]:.0f}, {one.largest_at_mm[1]:.0f}",
            )
            for one in maps
        ),
    ]


def _pixel_rows(maps: tuple[PixelMap, ...]) -> list[tuple[str, ...]]:
    return [
        ("camera", "plane", "median", "by noise", "largest", "largest elsewhere"),
        *(
            (
                one.camera,
                one.plane,
                f"{one.median_px:.2g}",
                _number(one.expected_median_px),
                f"{one.largest_px:.2g}",
                "" if one.outside_px is None else f"{one.outside_px:.2g}",
            )
            for one in maps
        ),
    ]


def _input_lines(found: InputsChange) -> list[str]:
    """What differs in the inputs."""
    lines = [
        f"spots: {found.spots_a} in A, {found.spots_b} in B, {found.shared} in both",
    ]
    for words, ids in (
        ("only in A", found.only_a),
        ("only in B", found.only_b),
        ("same id but other values", found.altered),
        ("left out by one only", found.rejected),
    ):
        if ids:
            more = f" and {len(ids) - _MOST_IDS} more" if len(ids) > _MOST_IDS else ""
            lines.append(f"{words}: {len(ids)} ({', '.join(ids[:_MOST_IDS])}{more})")
    lines += [
        f"option {one.name}: {one.a or 'none'} in A, {one.b or 'none'} in B"
        for one in found.options
    ]
    lines += [
        f"file {one.name}: {one.a[:_HASH] or 'none'} in A, {one.b[:_HASH] or 'none'} in B"
        for one in found.files
    ]
    lines += [f"{one.name}: A {one.a or 'unknown'}, B {one.b or 'unknown'}" for one in found.made]
    return ["Inputs:", *bullets(lines)]


def _number(value: float) -> str:
    return f"{value:.2g}" if value == value else "unknown"


def _chance(value: float) -> str:
    if value != value:
        return ""
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
