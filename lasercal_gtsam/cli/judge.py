"""`lasercal judge`: good, weak or bad, why, and the second opinions behind it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import bullets, json_option, print_json, wrapped

if TYPE_CHECKING:
    from lasercal_gtsam.opinions import Verdict
    from lasercal_gtsam.opinions.groups import LeftOut
    from lasercal_gtsam.opinions.levels import Level
    from lasercal_gtsam.opinions.split import Split
    from lasercal_gtsam.opinions.suspects import Finding

_MOST_ROWS = 8
_HEADINGS = {"bad": "Against it:", "weak": "To beware of:", "note": "Remarks:"}


@click.command(
    short_help="Judge a calibration: good, weak or bad, and why.",
    epilog="Exit status: 0 good or weak; 1 bad, or not readable.",
)
@click.argument("calibration", type=click.Path(path_type=Path))
@json_option
def judge(calibration: Path, as_json: bool) -> int:
    """Judge CALIBRATION (calibration.json): good, weak or bad, with reasons and what to do next.

    The tables below the reasons are what they rest on: residuals with parts of the chain let off,
    the faults looked for, every group of shots as the others predict it, two halves of the spots
    calibrated on their own, and tests of the residuals.
    """
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.opinions import judge as judged

    verdict = judged(load_calibration(calibration), halves=True)
    if as_json:
        print_json(document(verdict))
    else:
        click.echo("\n".join(report(verdict)))
    return 1 if verdict.grade == "bad" else 0


def document(verdict: Verdict) -> dict[str, Any]:
    """Build what ``--json`` prints."""
    from dataclasses import asdict

    opinions = asdict(verdict.opinions)
    halves = verdict.opinions.split
    if halves is not None:
        for row, kept in zip(opinions["split"]["rows"], halves.rows, strict=True):
            row["sigmas"] = kept.sigmas
    return {
        "verdict": verdict.grade,
        "reasons": [asdict(reason) for reason in verdict.reasons],
        "next_action": verdict.next_action,
        "opinions": opinions,
    }


def report(verdict: Verdict) -> list[str]:
    """Build the lines that are printed."""
    from lasercal_gtsam.calibration import text_table

    lines = [f"Verdict: {verdict.grade}. {verdict.next_action}"]
    for severity, heading in _HEADINGS.items():
        words = [reason.words for reason in verdict.reasons if reason.severity == severity]
        if words:
            lines += [heading, *bullets(words)]
    opinions = verdict.opinions

    def section(heading: str, rows: list[tuple[str, ...]]) -> None:
        if len(rows) > 1:
            table = text_table([*rows, ("",) * len(rows[0])]).splitlines()[:-2]
            lines.extend(["", wrapped(heading), *(f"  {line}" for line in table)])

    section(
        "Residuals (rms px) with parts of the chain let off; expected from the noise; chance of so "
        "large a fall from the full chain if what is let off is right:",
        _level_rows(opinions.levels),
    )
    section("The full chain, part by part (rms px):", _part_rows(opinions.levels))
    section("Faults looked for, the likeliest first:", _fault_rows(opinions.findings))
    section(
        "Groups of shots (one hand orientation on one plane) as the others predict them:",
        _group_rows(opinions.left_out),
    )
    if opinions.split is not None:
        if opinions.split.failure is not None:
            lines += ["", wrapped(f"Two halves of the spots: {opinions.split.failure}")]
        else:
            section(
                "Two halves of the spots, first minus second, largest first (chance that they "
                f"are of one cell: {_chance(opinions.split.chance)}):",
                _split_rows(opinions.split),
            )
    section(
        "Tests of the residuals (chance corrected for their number):",
        [
            ("test", "value", "chance", "asks whether"),
            *(
                (test.name, f"{test.value:.3g}", _chance(test.corrected), test.asks)
                for test in opinions.tests
            ),
        ],
    )
    return lines


def _level_rows(levels: tuple[Level, ...]) -> list[tuple[str, ...]]:
    return [
        ("level", "rms", "expected", "dof", "chance", "let off"),
        *(
            (
                level.name,
                f"{level.rms_px:.3g}",
                f"{level.expected_px:.3g}",
                str(level.dof),
                "" if level.name == "full" else _chance(level.chance),
                level.frees,
            )
            for level in levels
        ),
    ]


def _part_rows(levels: tuple[Level, ...]) -> list[tuple[str, ...]]:
    if not levels:
        return []
    parts = [part for part in levels[-1].parts if part.kind != "group"]
    groups = [part for part in levels[-1].parts if part.kind == "group"]
    groups.sort(key=lambda part: -part.rms_px / max(part.expected_px, 1e-12))
    return [
        ("part", "spots", "rms", "expected", "where"),
        *(
            (
                part.kind,
                str(part.spots),
                f"{part.rms_px:.3g}",
                f"{part.expected_px:.3g}",
                f"from {part.name}" if part.kind == "group" else part.name,
            )
            for part in (*parts, *groups[:_MOST_ROWS])
        ),
    ]


def _fault_rows(findings: tuple[Finding, ...]) -> list[tuple[str, ...]]:
    return [
        ("chance", "noise with it", "unknowns", "fault"),
        *(
            (_chance(f.chance), f"{f.shrink:.3f}", str(f.unknowns), f.words)
            for f in findings[:_MOST_ROWS]
        ),
    ]


def _group_rows(left_out: tuple[LeftOut, ...]) -> list[tuple[str, ...]]:
    worst = sorted(left_out, key=lambda g: g.chance if g.chance == g.chance else 2.0)
    rows: list[tuple[str, ...]] = [
        ("from spot", "plane", "spots", "px", "expected", "mm", "expected", "chance")
    ]
    for g in worst[:_MOST_ROWS]:
        if g.rms_px == g.rms_px:
            sizes = tuple(f"{x:.2g}" for x in (g.rms_px, g.expected_px, g.rms_mm, g.expected_mm))
            rows.append((g.first, g.plane, str(g.spots), *sizes, _chance(g.chance)))
        else:
            rows.append((g.first, g.plane, str(g.spots), "", "", "", "", "not predicted"))
    return rows


def _split_rows(split: Split) -> list[tuple[str, ...]]:
    worst = sorted(split.rows, key=lambda row: -abs(row.sigmas))[:_MOST_ROWS]
    return [
        ("row", "difference", "sigma", "in sigmas", "unit"),
        *(
            (row.name, f"{row.difference:.3g}", f"{row.sigma:.3g}", f"{row.sigmas:+.1f}", row.unit)
            for row in worst
        ),
    ]


def _chance(value: float) -> str:
    if value != value:
        return "unknown"
    return f"{value:.2g}" if value > 1e-15 else "< 1e-15"
