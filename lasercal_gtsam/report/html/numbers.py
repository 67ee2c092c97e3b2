"""Numbers as a reader wants them: decimals by the sigma, round ticks, a true minus sign."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lasercal_gtsam.calibration import plain_number

MINUS = "\N{MINUS SIGN}"
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)


def true_minus(text: str) -> str:
    """A printed number with a minus sign instead of a hyphen in front."""
    return MINUS + text[1:] if text.startswith("-") else text


def fixed(value: float | None, decimals: int, *, sign: bool = False) -> str:
    """A number with so many decimals, never minus zero; empty where there is none."""
    text = "" if value is None else plain_number(value, decimals)
    return f"+{text}" if sign and text and not text.startswith("-") else true_minus(text)


def significant(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent between 1e-4 and 1e6."""
    if value is None or not math.isfinite(value):
        return ""
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if not -5 < size < 6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = str(int(exponent)).translate(_RAISED)
        return f"{mantissa.replace('-', MINUS)}\N{MULTIPLICATION SIGN}10{power}"
    return fixed(value, max(digits - 1 - size, 0))


def chance(value: float | None) -> str:
    """A probability: two digits, and no more of a tiny one than that it is tiny."""
    if value is None or not math.isfinite(value):
        return ""
    return "< 0.0001" if value < 1e-4 else significant(value, 2)


def tail(text: str) -> tuple[int, bool]:
    """Decimals of a printed number, and whether it has a decimal point."""
    _, point, rest = text.partition(".")
    return len(rest), bool(point)


def axis_ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round values from ``low`` to ``high``."""
    if not high > low:
        return [low]
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * min(_ROUND, key=lambda r: abs(math.log(r * power / rough)))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def tick_text(value: float, ticks: Sequence[float]) -> str:
    """A tick with as many decimals as their step needs."""
    if len(ticks) < 2:
        return significant(value, 3)
    step = abs(ticks[1] - ticks[0])
    decimals = max(-math.floor(math.log10(step) + 1e-9), 0)
    # a step of 2.5 needs one decimal more than its size says
    if abs(round(step, decimals) - step) > 1e-6 * step:
        decimals += 1
    return fixed(value, decimals)
