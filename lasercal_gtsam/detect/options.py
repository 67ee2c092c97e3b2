"""What the detector may be told; every field has a meaning written down."""

from __future__ import annotations

from dataclasses import dataclass, fields

from lasercal_gtsam.errors import DataError

# no setting means anything beyond; pictures are of single precision
_LARGEST = 1e9


@dataclass(frozen=True)
class DetectionOptions:
    """Options of `detect_spot`; the defaults were measured on rendered and real pictures.

    Attributes
    ----------
    saturation_level
        Pixel value from which a pixel counts as saturated. None: the largest value of the
        picture's type, and in 16-bit or float pictures also a plateau of several equal pixels at
        the picture's maximum (a 12-bit camera in 16-bit files clips at 4095).
    black_level
        Pixel value without any light; needed only where the off frame is divided out.
    channel
        Colour pictures: ``"auto"`` (the channel that the laser lights most without clipping),
        ``"blue"``, ``"green"``, ``"red"`` or ``"gray"``.
    divide_albedo
        Divide the difference by the smoothed off frame where that is well above its noise: takes
        out printed edges and texture under the spot, supposing that ambient and laser light meet
        the same reflectance.
    threshold_sigmas
        A candidate rises above the noise of the filtered difference by this factor.
    clutter_shift_px, clutter_gain
        What a shift of the camera and a flicker of the lamp between the two frames leave over is
        expected to be ``clutter_shift_px * |gradient of off| + clutter_gain * off``; a candidate
        rises above three times that.
    ambiguous_ratio, ambiguous_ratio_single
        A second candidate with more than this share of the first one's peak makes the picture
        ambiguous; the second value holds without an off frame.
    edge_margin_px
        A spot whose centre (or whose 20 % contour) comes nearer than this to the edge is not used.
    min_area_px, max_area_px
        Number of pixels that a spot may have: at least so many above 10 % of its peak, at most so
        many above 20 % after a blur.
    max_elongation
        Largest ratio of the spot's axes.
    max_saturated_share
        Number of saturated pixels over the number above half of the clipped peak, above which a
        spot is not used. (0.9 is met at some hundred times the light that saturates; saturation
        below the limit is in the covariance.)
    min_snr
        Peak over background noise below which a spot is not used.
    max_sigma_px
        A spot whose centre is less certain than this (1 sigma, worst direction) is not used.
    floor_px
        Standard deviation added to every centre; 0.1 to 0.2 for compressed pictures or cameras
        that set their own exposure.
    region
        Corners ((u, v), ...) of a polygon in pixels, for example the outline of the working
        plane: a spot outside is not used. None: the whole picture.
    """

    saturation_level: float | None = None
    black_level: float = 0.0
    channel: str = "auto"
    divide_albedo: bool = True
    threshold_sigmas: float = 7.0
    clutter_shift_px: float = 0.1
    clutter_gain: float = 0.01
    ambiguous_ratio: float = 0.35
    ambiguous_ratio_single: float = 0.1
    edge_margin_px: float = 1.0
    min_area_px: int = 4
    max_area_px: int = 4000
    max_elongation: float = 8.0
    max_saturated_share: float = 0.9
    min_snr: float = 5.0
    max_sigma_px: float = 1.0
    floor_px: float = 0.02
    region: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        problems = []
        if self.channel not in CHANNELS:
            problems.append(
                f"DetectionOptions.channel: expected one of {', '.join(CHANNELS)}, "
                f"got {self.channel!r}"
            )
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name in ("channel", "region", "divide_albedo") or value is None:
                continue
            if not 0 <= value <= _LARGEST:  # nor NaN
                problems.append(
                    f"DetectionOptions.{f.name}: expected a number from 0 to {_LARGEST:g}, got "
                    f"{value:g}"
                )
        if self.region is not None and len(self.region) < 3:
            problems.append(
                f"DetectionOptions.region: expected 3 corners or more, got {len(self.region)}"
            )
        if problems:
            raise DataError(*problems)


CHANNELS = ("auto", "blue", "green", "red", "gray")
