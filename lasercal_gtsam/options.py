"""What a calibration may be asked to do; every field has a meaning written down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from lasercal_gtsam.errors import DataError

Robust = Literal["auto", "none", "huber", "cauchy", "geman-mcclure", "gnc-tls"]
DISTORTION_NAMES = ("k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of `calibrate`; frozen, and kept in the result.

    Attributes
    ----------
    sigma_px
        Pixel sigma of spots that carry no covariance of their own; None: estimated from the
        residuals (a posteriori).
    hand_sigma_m, hand_sigma_rad
        Robot noise of a commanded hand pose, 1 sigma per axis (metres, radians).
    robust
        Loss on the whitened residual length of a spot.
    distortion
        Which distortion terms are estimated: ``"all"``, ``"none"``, ``"auto"`` or names out of
        ``k1 k2 p1 p2``; the others are held at the start's value (zero without one).
    known
        Values held fixed: ``principal_point`` (u0, v0), ``skew`` (px), ``aspect`` (fu / fv), and
        any intrinsic by name (``fu fv u0 v0 k1 k2 p1 p2``). With several cameras
        ``"<camera>.<name>"`` addresses one of them.
    fixed
        Held at the start's value: any intrinsic by name, ``"intrinsics"``, ``"T_base_camera"``,
        or whole parts ``"camera:<name>"``, ``"laser:<name>"``, ``"plane:<name>"``.
    priors
        Gaussian priors on rows of the result table: name -> (mean, sigma), in the table's units
        (px, mm, deg); ``"aspect"`` means fu / fv.
    max_iterations
        Limit of the Levenberg-Marquardt iterations of one solve.
    seed
        Seed of everything that draws numbers; the default path draws none.
    """

    sigma_px: float | None = None
    hand_sigma_m: float = 0.0
    hand_sigma_rad: float = 0.0
    robust: Robust = "auto"
    distortion: str | tuple[str, ...] = "all"
    known: Mapping[str, Any] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    max_iterations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        if self.robust not in get_args(Robust):
            raise DataError(
                f"options.robust: got {self.robust!r}, expected one of "
                + ", ".join(get_args(Robust))
            )
