"""The trace of a running calibration: every parameter and its sigma against the spot number."""

from __future__ import annotations

from dataclasses import dataclass

from lasercal_gtsam.calibration import Parameter


@dataclass(frozen=True)
class HistoryRow:
    """The table at one moment.

    Attributes
    ----------
    spots : spots given so far
    rms_px, sigma0 : as in `Fit`
    parameters : rows of the table; ``refined`` and ``sigma`` count
    events : sentences about what happened since the row before
    """

    spots: int
    rms_px: float
    sigma0: float
    parameters: tuple[Parameter, ...]
    events: tuple[str, ...] = ()
