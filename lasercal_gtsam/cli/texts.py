"""What the commands say about spots and results, as text for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from lasercal_gtsam.cli.console import bullets, wrapped
from lasercal_gtsam.report.words import count as count
from lasercal_gtsam.report.words import noise_sentence, sentence

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.io.spot_account import RowSpot, SpotAccount

_MOST_LINES = 20


def looked_at(account: SpotAccount) -> int:
    """How many pictures the detector saw."""
    return sum(detection is not None for detection in account.detections)


def account_lines(rows: Iterable[RowSpot], elsewhere: str) -> list[str]:
    """Rows that gave no spot, by verdict, each with its picture and the reason.

    ``elsewhere`` says where the rest is, where there are too many to print.
    """
    groups: dict[str, list[RowSpot]] = {}
    for row in rows:
        if row.verdict != "used":
            groups.setdefault(row.verdict, []).append(row)
    lines = []
    for verdict, members in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        lines.append(f"  {verdict} ({len(members)})")
        lines += [
            wrapped(f"{row.id}: {row.reason}" if row.reason else row.id, "    ", "        ")
            for row in members[:_MOST_LINES]
        ]
        if len(members) > _MOST_LINES:
            lines.append(f"    ... and {len(members) - _MOST_LINES} more: {elsewhere}")
    return lines


def result_lines(calibration: Calibration, table: str | None = None) -> list[str]:
    """The table and what must be known to judge it: status, noise, held, rejected, weak.

    ``table`` takes the place of ``calibration.table()``.
    """
    observability = calibration.observability
    rejected = [
        f"{spot.id} (plane {spot.plane}): {spot.rejected}"
        for spot in calibration.spots
        if spot.rejected is not None
    ]
    lines = [table or calibration.table(), "", wrapped(sentence(calibration.fit.status))]
    lines.append(wrapped(noise_sentence(calibration)))
    lines += _section("Held or assumed:", observability.held)
    lines += _section(
        f"Rejected: {count(len(rejected), 'spot')} that cannot be explained by noise:",
        _cut(rejected, "all are in the result file"),
    )
    lines += _section(
        "Weakly determined: changes like these, made together, hardly show in the residuals. Turn "
        "the hand more, add a plane or spots near the picture's corners, or give what you know "
        "with --known:",
        [direction.words for direction in observability.weak],
    )
    remarks = [note for note in observability.notes if note not in calibration.fit.status]
    return [*lines, *_section("Remarks:", remarks)]


def _section(heading: str, lines: Sequence[str]) -> list[str]:
    return [wrapped(heading), *bullets(lines)] if lines else []


def _cut(lines: Sequence[str], elsewhere: str) -> list[str]:
    if len(lines) <= _MOST_LINES:
        return list(lines)
    return [*lines[:_MOST_LINES], f"... and {len(lines) - _MOST_LINES} more: {elsewhere}"]
