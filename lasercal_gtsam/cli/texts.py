"""What the commands say about spots and results, as text for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from lasercal_gtsam.cli.console import bullets, wrapped

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.io.spot_account import RowSpot, SpotAccount

_MOST_LINES = 20
# residuals this many times larger than the stated noise deserve a word
_SUSPICIOUS = 1.5


def count(number: int, noun: str) -> str:
    """``1 spot``, ``2 spots``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


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
    lines = [table or calibration.table(), "", wrapped(_sentence(calibration.fit.status))]
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
    if not calibration.fit.converged:  # otherwise they are part of the status
        lines += _section("Remarks:", observability.notes)
    return lines


def noise_sentence(calibration: Calibration) -> str:
    """What sigma0 means here: a pixel sigma, or a check of the stated noise."""
    import numpy as np

    fit, options = calibration.fit, calibration.inputs.options
    if not np.isfinite(fit.sigma0):
        return "There are as many unknowns as measurements: no sigmas can be stated."
    behind = f"{fit.dof:.0f} degrees of freedom"
    pixels_stated = (
        options.sigma_px is not None or not np.isnan(calibration.inputs.observations.cov_uv).all()
    )
    hand_stated = options.hand_sigma_m > 0 or options.hand_sigma_rad > 0
    if not (pixels_stated or hand_stated):
        return f"Noise of a pixel coordinate, from the residuals: {fit.sigma0:.3g} px ({behind})."
    noise = "the stated noise" if pixels_stated else "1 px and the stated noise of the hand"
    text = f"The residuals are {fit.sigma0:.3g} times what {noise} explains ({behind})"
    if fit.sigma0 > _SUSPICIOUS:
        return (
            f"{text}: poses, planes or the camera are less exact than stated. The sigmas are "
            "widened by that factor."
        )
    return f"{text}; the sigmas are scaled by that factor."


def _section(heading: str, lines: Sequence[str]) -> list[str]:
    return [wrapped(heading), *bullets(lines)] if lines else []


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


def _cut(lines: Sequence[str], elsewhere: str) -> list[str]:
    if len(lines) <= _MOST_LINES:
        return list(lines)
    return [*lines[:_MOST_LINES], f"... and {len(lines) - _MOST_LINES} more: {elsewhere}"]
