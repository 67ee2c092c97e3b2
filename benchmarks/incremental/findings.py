"""What was asked of a measurement, what was found, and whether that is met."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Finding(NamedTuple):
    """One row. ``met`` is None where nothing was asked: the number is for information."""

    what: str
    asked: str
    found: str
    met: bool | None = None


def at_most(what: str, found: float, limit: float, unit: str = "") -> Finding:
    return Finding(what, f"at most {limit:g}{unit}", f"{found:.3g}{unit}", bool(found <= limit))


def at_least(what: str, found: float, limit: float, unit: str = "") -> Finding:
    return Finding(what, f"at least {limit:g}{unit}", f"{found:.3g}{unit}", bool(found >= limit))


def share(what: str, good: Sequence[bool], limit: float) -> Finding:
    """Share of ``good``, at least ``limit``."""
    asked, found = f"at least {100 * limit:g} %", f"{100 * fraction(good):.0f} % of {len(good)}"
    return Finding(what, asked, found, fraction(good) >= limit)


def fraction(good: Sequence[bool]) -> float:
    return sum(good) / len(good) if good else 0.0


def print_table(rows: Iterable[Iterable[str]]) -> None:
    """A table in Markdown; the first row is its head."""
    head, *rest = (list(row) for row in rows)
    print("\n| " + " | ".join(head) + " |\n|" + " --- |" * len(head))
    for row in rest:
        print("| " + " | ".join(row) + " |")
    print(flush=True)


def print_findings(findings: Sequence[Finding]) -> bool:
    """Print them; whether all that was asked is met."""
    words = {None: "", True: "met", False: "NOT MET"}
    rows = [(f.what, f.asked, f.found, words[f.met]) for f in findings]
    print_table([("what", "asked", "found", ""), *rows])
    return all(f.met is not False for f in findings)
