"""What a calibration may be asked to do; every field has a meaning written down."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from typing import Any, Literal, get_args

from lasercal_gtsam.errors import DataError

Robust = Literal["auto", "none", "huber", "cauchy", "geman-mcclure", "gnc-tls"]
HAND_NOISE_NAMES = ("hand_sigma_m", "hand_sigma_rad")
# squares of sigmas beyond these over- or underflow, and no robot or camera has them
SMALLEST_SIGMA, LARGEST_SIGMA = 1e-12, 1e6
_MOST_ITERATIONS = 1_000_000
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
    estimate_noise
        Which of these two nobody knows: ``"hand_sigma_m"``, ``"hand_sigma_rad"`` or both. They are
        estimated from the residuals, together with the pixel sigma where ``sigma_px`` is None; what
        is stated stays.
    robust
        What is done about outliers. ``"auto"``: looked for with a redescending loss, named and left
        out, then least squares; on clean data plain least squares to the last digit.
        ``"gnc-tls"``: the same by graduated truncated least squares. ``"huber"``, ``"cauchy"``,
        ``"geman-mcclure"``: none left out, each weighed by that loss on the length of its whitened
        residual, at 95 % efficiency on clean data. ``"none"``: least squares on all spots.
    distortion
        Which distortion terms are estimated: ``"all"``, ``"none"``, names out of
        ``k1 k2 p1 p2``, or ``"auto"``: those that the spots can carry, by an information criterion
        (`lens_choice`), with the reason in the notes; a running calibration keeps those it began
        with. The others are held at the start's value (zero without one).
    known
        Values held fixed: ``principal_point`` (u0, v0), ``skew`` (px), ``aspect`` (fu / fv), and
        any intrinsic by name (``fu fv u0 v0 k1 k2 p1 p2``). With several cameras
        ``"<camera>.<name>"`` addresses one of them.
    fixed
        Held at the value of a given start: any intrinsic by name, ``"intrinsics"``,
        ``"T_base_camera"``, or whole parts ``"camera:<name>"``, ``"laser:<name>"``,
        ``"plane:<name>"``. Without a given start only distortion terms, at zero.
    priors
        Gaussian priors on rows of the result table: name -> (mean, sigma), in the table's units
        (px, mm, deg); ``"aspect"`` means fu / fv.
    max_iterations
        Limit of the Levenberg-Marquardt iterations of one solve.
    seed
        Seed of everything that draws numbers; the default path draws none.

    Raises
    ------
    DataError
        A field is not what it may be; names all of them. (Names of parameters and parts are checked
        by `calibrate`, which knows the observations.)
    """

    sigma_px: float | None = None
    hand_sigma_m: float = 0.0
    hand_sigma_rad: float = 0.0
    estimate_noise: tuple[str, ...] = ()
    robust: Robust = "auto"
    distortion: str | tuple[str, ...] = "all"
    known: Mapping[str, Any] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    max_iterations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        problems = [*_number_problems(self), *_distortion_problems(self.distortion)]
        if self.robust not in get_args(Robust):
            allowed = ", ".join(get_args(Robust))
            problems.append(f"options.robust: expected one of {allowed}, got {self.robust!r}")
        problems += _estimate_problems(self)
        named = isinstance(self.fixed, tuple | list) and all(isinstance(x, str) for x in self.fixed)
        if not named:
            problems.append(f"options.fixed: expected a tuple of names, got {self.fixed!r}")
        problems += [
            f"options.{name}: expected a dict, got {getattr(self, name)!r}"
            for name in ("known", "priors")
            if not isinstance(getattr(self, name), Mapping)
        ]
        if problems:
            raise DataError(*problems)
        object.__setattr__(self, "fixed", tuple(self.fixed))
        wanted = tuple(name for name in HAND_NOISE_NAMES if name in self.estimate_noise)
        object.__setattr__(self, "estimate_noise", wanted)
        if not isinstance(self.distortion, str):
            object.__setattr__(self, "distortion", tuple(self.distortion))

    @property
    def noisy_hand(self) -> bool:
        """Whether the robot's noise is stated, or to be estimated."""
        return self.hand_sigma_m > 0 or self.hand_sigma_rad > 0 or bool(self.estimate_noise)


def _number_problems(options: CalibrationOptions) -> list[str]:
    wanted = {
        "sigma_px": (
            options.sigma_px is None or _is_sigma(options.sigma_px),
            f"a number of pixels from {SMALLEST_SIGMA:g} to {LARGEST_SIGMA:g}",
        ),
        "hand_sigma_m": (
            options.hand_sigma_m == 0 or _is_sigma(options.hand_sigma_m),
            f"0 or metres from {SMALLEST_SIGMA:g} to {LARGEST_SIGMA:g}",
        ),
        "hand_sigma_rad": (
            options.hand_sigma_rad == 0 or _is_sigma(options.hand_sigma_rad),
            f"0 or radians from {SMALLEST_SIGMA:g} to {LARGEST_SIGMA:g}",
        ),
        "max_iterations": (
            isinstance(options.max_iterations, int)
            and 1 <= options.max_iterations <= _MOST_ITERATIONS,
            f"an integer from 1 to {_MOST_ITERATIONS}",
        ),
        "seed": (isinstance(options.seed, Integral) and options.seed >= 0, "an integer >= 0"),
    }
    return [
        f"options.{name}: expected {what}, got {getattr(options, name)!r}"
        for name, (good, what) in wanted.items()
        if not good
    ]


def _estimate_problems(options: CalibrationOptions) -> list[str]:
    wanted = options.estimate_noise
    good = isinstance(wanted, tuple | list) and all(x in HAND_NOISE_NAMES for x in wanted)
    if not good:
        allowed = " and ".join(map(repr, HAND_NOISE_NAMES))
        hint = f"; a single name is written ({wanted!r},)" if isinstance(wanted, str) else ""
        return [f"options.estimate_noise: expected a tuple out of {allowed}, got {wanted!r}{hint}"]
    return [
        f"options.estimate_noise: {name} is to be estimated, but also stated "
        f"({getattr(options, name)!r}); leave one out"
        for name in wanted
        if getattr(options, name) != 0
    ]


def _is_sigma(value: Any) -> bool:
    return SMALLEST_SIGMA <= _finite(value) <= LARGEST_SIGMA


def _finite(value: Any) -> float:
    """The number, or NaN where it is not one (no comparison is true of NaN)."""
    try:
        return float(value) if isinstance(value, Real) and math.isfinite(value) else math.nan
    except OverflowError:  # an integer of hundreds of digits
        return math.nan


def _distortion_problems(wanted: Any) -> list[str]:
    allowed = f"'all', 'none', 'auto' or names out of {', '.join(DISTORTION_NAMES)}"
    if isinstance(wanted, str):
        good = wanted in ("all", "none", "auto")
    else:
        good = isinstance(wanted, tuple | list) and all(x in DISTORTION_NAMES for x in wanted)
    if good:
        return []
    hint = f"; a single name is written ({wanted!r},)" if wanted in DISTORTION_NAMES else ""
    return [f"options.distortion: expected {allowed}, got {wanted!r}{hint}"]
