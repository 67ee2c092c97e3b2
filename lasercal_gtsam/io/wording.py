"""Pieces of error messages that several readers share."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

MAX_PROBLEMS = 20
# Shown of a value that is wrong; more would bury the message.
_LONGEST_VALUE = 60


def quoted(text: str) -> str:
    """The text in quotes, cut where it is long, with what cannot be printed as escapes."""
    shown = repr(text)
    return shown if len(shown) <= _LONGEST_VALUE else f"{shown[: _LONGEST_VALUE - 3]}..."


def cannot_be_a_name(text: str) -> str | None:
    """What speaks against a text as a name, as the end of a sentence; None if nothing does."""
    if text.isprintable():
        return None
    odd = next(c for c in text if not c.isprintable())
    return f"{quoted(text)} holds U+{ord(odd):04X}, which cannot be seen; write the name without it"


def nearest(found: str, allowed: Iterable[str]) -> str | None:
    """The allowed word that ``found`` is probably meant to be, if any; case does not count."""
    if len(found) > _LONGEST_VALUE:
        return None  # comparing takes time that grows with the square of the length
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
    if len(shown) > _LONGEST_VALUE * limit:
        shown = shown[: _LONGEST_VALUE * limit] + "..."
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
