"""What a running calibration was asked to do."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lasercal_factors.stream_kernels import Weighing

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.hand_noise import HandNoise
from lasercal_gtsam.options import CalibrationOptions

_FEWEST_KEPT, _SHORTEST_LIFE = 50, 10


@dataclass(frozen=True)
class Settings:
    """Options of `IncrementalCalibrator`, and the noise that they come to.

    Attributes
    ----------
    options, automatic, max_spots, half_life : as given
    sigma_px : pixel sigma of spots that have none of their own
    unit : pixel sigma that the a-posteriori scale is told in; 1 where the scale is a factor

    Raises
    ------
    DataError
        A number that makes no sense.
    """

    options: CalibrationOptions
    automatic: bool
    max_spots: int | None
    half_life: float | None
    sigma_px: float
    unit: float = 1.0

    def __post_init__(self) -> None:
        if self.max_spots is not None and not self.max_spots >= _FEWEST_KEPT:
            raise DataError(
                f"max_spots: expected {_FEWEST_KEPT} spots or more, got {self.max_spots!r}"
            )
        if self.half_life is not None and not self.half_life >= _SHORTEST_LIFE:
            raise DataError(
                f"half_life: expected {_SHORTEST_LIFE} spots or more, got {self.half_life!r}"
            )

    @property
    def hand(self) -> HandNoise:
        """Declared noise of a hand pose."""
        return HandNoise.of(self.options)

    @property
    def weighing(self) -> Weighing:
        """The same, and the fading, for the kernels."""
        fade = 1.0 if self.half_life is None else 0.5 ** (1.0 / self.half_life)
        return Weighing(self.hand.variances, fade)

    @property
    def robust(self) -> bool:
        """Whether outliers are left out."""
        return self.options.robust != "none"

    @property
    def finds_sigma(self) -> bool:
        """Whether the pixel sigma has to be told apart from the robot's noise."""
        return self.options.sigma_px is None and max(self.hand) > 0

    def informed_by(self, found: Calibration) -> Settings:
        """With the noise levels that a solution has found, where some were missing."""
        told = replace(self, options=found.options_used) if found.fit.noise else self
        if not told.finds_sigma:
            return told
        return replace(told, sigma_px=found.fit.sigma0, unit=found.fit.sigma0)
