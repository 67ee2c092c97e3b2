"""What can go wrong, one class per concern. The command line prints these in one line."""

from __future__ import annotations

from lasercal_factors.errors import LasercalError

__all__ = ["DataError", "DegenerateError", "DetectionError", "LasercalError", "SolveError"]


class DataError(LasercalError):
    """The input is wrong: what was found, where, what was expected, what to do.

    Attributes
    ----------
    problems : tuple of str
        Every problem found in the input; the message joins them, one a line.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class DegenerateError(LasercalError):
    """The data cannot give what was asked: names what is missing and what would supply it."""


class SolveError(LasercalError):
    """The optimisation ended without an answer that can be trusted; the message says why."""


class DetectionError(LasercalError):
    """A picture could not be used at all (unreadable, wrong size); not 'no spot found'."""
