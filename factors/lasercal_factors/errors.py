"""Exceptions shared by both packages; the root lives here because imports only go down."""

from __future__ import annotations


class LasercalError(Exception):
    """Root of every error raised on purpose: catch this to catch all of ours."""


class FactorError(LasercalError):
    """A factor was built or used wrongly (shapes, keys, a spot that cannot be projected)."""
