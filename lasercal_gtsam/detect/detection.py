"""What was found in a picture: the spot, how certain it is, and the verdict with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array

Verdict = Literal[
    "used",
    "none",
    "ambiguous",
    "saturated",
    "edge",
    "outside",
    "too_small",
    "too_large",
    "elongated",
    "weak",
    "uncertain",
]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


@dataclass(frozen=True, eq=False)
class RunnerUp(FrozenData):
    """The second strongest candidate of a picture.

    Attributes
    ----------
    uv : (2,) array
        Pixel of its peak.
    ratio : float
        Its peak over the first one's, after the same blur.
    """

    uv: Array
    ratio: float

    def __post_init__(self) -> None:
        set_array(self, "uv", self.uv, (2,))


@dataclass(frozen=True, eq=False)
class Detection(FrozenData):
    """The spot in one picture and what to think of it.

    Attributes
    ----------
    verdict : str
        ``used``: take it. ``none``: no candidate. ``ambiguous``: a second spot is nearly as strong.
        ``saturated``, ``edge``, ``outside`` (of the given region), ``too_small``, ``too_large``,
        ``elongated``, ``weak``, ``uncertain``: found, but not to be trusted.
    reason : str
        One sentence with the numbers behind the verdict.
    uv : (2,) array
        Centre, pixels; (0, 0) is the centre of the top-left pixel. NaN where nothing was found.
    cov_uv : (2, 2) array
        Its covariance, px^2; NaN with ``uv``.
    peak, noise, snr : float
        Height of the spot and standard deviation of the background (pixel values), and their
        ratio.
    n_saturated : int
        Saturated pixels of the spot, in the channel that was used.
    sigma_major, sigma_minor, angle_rad : float
        Spot size (Gaussian sigma along its axes, pixels) and the angle of the major axis from u
        towards v.
    channel : str
        ``mono``, ``blue``, ``green``, ``red`` or ``gray``.
    single_frame : bool
        No off frame was given: the picture is trusted less.
    method : str
        ``fit`` or ``centroid`` (where the fit was not to be trusted), or empty.
    runner_up : RunnerUp or None
        The second strongest candidate.
    """

    verdict: Verdict
    reason: str
    uv: Array
    cov_uv: Array
    peak: float = 0.0
    noise: float = 0.0
    snr: float = 0.0
    n_saturated: int = 0
    sigma_major: float = float("nan")
    sigma_minor: float = float("nan")
    angle_rad: float = float("nan")
    channel: str = "mono"
    single_frame: bool = False
    method: str = ""
    runner_up: RunnerUp | None = None

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise DataError(
                f"Detection.verdict: expected one of {', '.join(VERDICTS)}, got {self.verdict!r}"
            )
        uv = set_array(self, "uv", self.uv, (2,), finite=self.verdict == "used")
        set_array(self, "cov_uv", self.cov_uv, (2, 2), finite=bool(np.isfinite(uv).all()))

    @property
    def found(self) -> bool:
        """There is a candidate, trusted or not."""
        return self.verdict != "none"

    @property
    def usable(self) -> bool:
        """The spot may go into a calibration."""
        return self.verdict == "used"
