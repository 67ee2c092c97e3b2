"""How pictures are rendered: camera, lamp, surface and laser; every field has a meaning written."""

from __future__ import annotations

from dataclasses import dataclass

from lasercal_gtsam.errors import DataError


@dataclass(frozen=True)
class RenderOptions:
    """What the camera, the lamp, the surface and the laser are like.

    Levels are fractions of full scale (the level at which a pixel saturates).

    Attributes
    ----------
    bits
        8 or 16: depth of the written picture.
    spot_level
        Peak of the spot above the ambient light before speckle and pixel integration, on albedo 1.
        Above 1 the spot saturates.
    speckle_contrast, speckle_grain_px
        Standard deviation over mean of the speckle (0 none, 1 fully developed), and the size of a
        grain: the correlation area is 1.2 grain^2.
    psf_sigma_px
        Blur of the lens, Gaussian.
    skirt_fraction, skirt_scale, skirt_shift
        Share of the spot's power in a wide skirt of scattered light, its size in units of the
        spot's, and its offset along the spot's major axis in sigmas of the spot. A shifted skirt
        moves the centroid: it is a model error on purpose.
    ambient_level, ambient_gradient
        Brightness of the plane without the laser, and its relative change across the image.
    texture
        Relative standard deviation of the albedo (fine and coarse structure together).
    patches
        Number of printed rectangles with sharp edges; each changes the albedo by up to 40 %.
    highlights
        Number of static bright spots that are in both frames.
    ghost_probability, ghost_level
        Chance that a picture holds a second spot made by the laser (a reflection), and the range
        its peak is drawn from, relative to the spot's.
    flicker
        Relative standard deviation of the lamp between the two frames.
    jitter_px
        Standard deviation, per axis, of the camera's shift between the two frames. It moves the
        off frame: the spot stays where it was asked for.
    full_well_e, read_noise_e, prnu
        Electrons at saturation, read noise in electrons, relative pixel gain error.
    saturation_dn
        Pixel value at saturation; None: the largest of ``bits`` (a 12-bit camera in 16-bit files
        has 4095).
    """

    bits: int = 8
    spot_level: float = 0.45
    speckle_contrast: float = 0.3
    speckle_grain_px: float = 1.2
    psf_sigma_px: float = 0.6
    skirt_fraction: float = 0.02
    skirt_scale: float = 3.0
    skirt_shift: float = 0.5
    ambient_level: float = 0.2
    ambient_gradient: float = 0.3
    texture: float = 0.06
    patches: int = 4
    highlights: int = 2
    ghost_probability: float = 0.1
    ghost_level: tuple[float, float] = (0.05, 0.6)
    flicker: float = 0.01
    jitter_px: float = 0.05
    full_well_e: float = 10_000.0
    read_noise_e: float = 8.0
    prnu: float = 0.005
    saturation_dn: int | None = None

    def __post_init__(self) -> None:
        checks = [
            (self.bits in (8, 16), "bits", "8 or 16"),
            *((getattr(self, name) > 0, name, "more than 0") for name in _POSITIVE),
            *((getattr(self, name) >= 0, name, "0 or more") for name in _NOT_NEGATIVE),
            *((0 <= getattr(self, name) <= 1, name, "0 to 1") for name in _SHARES),
            (
                0 <= self.ghost_level[0] <= self.ghost_level[1],
                "ghost_level",
                "(low, high) with 0 <= low <= high",
            ),
        ]
        problems = [
            f"RenderOptions.{name}: expected {wanted}, got {getattr(self, name)}"
            for good, name, wanted in checks
            if not good
        ]
        if not problems and not 0 < self.full_scale <= 2**self.bits - 1:
            problems.append(
                f"RenderOptions.saturation_dn: expected 1 to {2**self.bits - 1} with "
                f"{self.bits} bits, got {self.saturation_dn}"
            )
        if problems:
            raise DataError(*problems)

    @property
    def full_scale(self) -> int:
        """Pixel value at saturation."""
        return 2**self.bits - 1 if self.saturation_dn is None else self.saturation_dn


_POSITIVE = ("spot_level", "speckle_grain_px", "full_well_e", "skirt_scale")
_SHARES = ("speckle_contrast", "skirt_fraction", "ghost_probability")
_NOT_NEGATIVE = (
    "psf_sigma_px",
    "ambient_level",
    "ambient_gradient",
    "texture",
    "patches",
    "highlights",
    "flicker",
    "jitter_px",
    "read_noise_e",
    "prnu",
)
