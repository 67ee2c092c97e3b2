"""Time stamps: whole nanoseconds, exact where a float of seconds since 1970 is not."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

import numpy as np
import numpy.typing as npt

NS_PER_S = 1_000_000_000
LATEST = 2**63 - 1  # a clock counts nanoseconds in 64 bits: until the year 2262
Stamps = npt.NDArray[np.int64]


def ns_from_seconds(text: str) -> int | None:
    """Nanoseconds of a decimal number of seconds, to the last digit; None if it is no such time.

    Digits beyond the nanosecond are rounded.
    """
    try:
        value = Decimal(text) if text.isascii() and "_" not in text else Decimal("nan")
    except InvalidOperation:
        return None
    if not value.is_finite() or abs(value) > Decimal(LATEST) / NS_PER_S:
        return None
    return int((value * NS_PER_S).to_integral_value())


def ns_from_integer(text: str) -> int | None:
    """Nanoseconds written as a whole number; None if it is none that a clock shows."""
    if not (text.isascii() and text.isdecimal() and len(text) <= len(str(LATEST))):
        return None
    stamp = int(text)
    return stamp if stamp <= LATEST else None


def seconds_text(stamp: int) -> str:
    """A stamp in seconds with all its digits."""
    seconds, rest = divmod(abs(stamp), NS_PER_S)
    return f"{'-' if stamp < 0 else ''}{seconds}.{rest:09d}"


def duration_text(ns: float) -> str:
    """A duration in words, three digits."""
    seconds = ns / NS_PER_S
    if abs(seconds) >= 120:
        return f"{seconds / 60:.3g} min" if abs(seconds) < 7200 else f"{seconds / 3600:.3g} h"
    return f"{seconds:.3g} s" if abs(seconds) >= 0.1 else f"{seconds * 1e3:.3g} ms"


def as_stamps(values: npt.ArrayLike) -> Stamps:
    """An array of stamps that cannot be written to."""
    stamps = np.array(values, dtype=np.int64)
    stamps.flags.writeable = False
    return stamps


def last_before(stamps: Stamps, stamp: int) -> int | None:
    """Index of the last of increasing stamps that is not after ``stamp``; None before all."""
    k = int(np.searchsorted(stamps, stamp, side="right")) - 1
    return None if k < 0 else k
