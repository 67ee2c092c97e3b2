"""Pieces of error messages that several readers share."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

MAX_PROBLEMS = 20


def nearest(found: str, allowed: Iterable[str]) -> str | None:
    """The allowed word that ``found`` is probably meant to be, if any; case does not count."""
    by_lower = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(found.lower(), by_lower, n=1, cutoff=0.6)
    return by_lower[near[0]] if near else None


def did_you_mean(found: str, allowed: Iterable[str]) -> str:
    """``" (did you mean 'kuka'?)"`` for a near miss, else an empty string."""
    near = nearest(found, allowed)
    return "" if near is None else f" (did you mean {near!r}?)"


def at_most(problems: Sequence[str], limit: int = MAX_PROBLEMS) -> list[str]:
    """The first ``limit`` problems and, if there are more, a line that says how many."""
    if len(problems) <= limit:
        return list(problems)
    return [*problems[:limit], f"... and {len(problems) - limit} more problems"]


def some(names: Sequence[str], limit: int = 5) -> str:
    """``a, b, c and 7 more`` for lists in a sentence."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
