"""Pictures of a laser spot on a working plane: laser on and laser off, with the truth known.

The spot is the image of a beam with a Gaussian cross-section: on an oblique plane it is an ellipse,
and the camera maps it by the derivative of the pixel with respect to the beam's lateral position
(`spot_shape`). Its centre is the pixel of the beam axis, exactly, because a Gaussian stays one
under a linear map. Everything that makes real spots hard is added on the way to the pixel values:
speckle (drawn anew for each picture), albedo seen alike by ambient and laser light, a skirt of
scattered light, reflections made by the laser, static highlights, lamp flicker, camera jitter,
shot and read noise, pixel gain, quantisation and saturation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Beam, Cell, check_image_size
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.projection import project
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.simulate.render_options import RenderOptions

Image = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

__all__ = ["Picture", "RenderOptions", "Scene", "make_scene", "render_pair", "spot_shape"]

_REACH = 6.0  # sigmas of the spot that are drawn: beyond, exp(-18) of the peak


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays between pictures of one plane in one camera; arrays (height, width) float32.

    Attributes
    ----------
    albedo
        Relative reflectance, about 1.
    ambient
        Light from the plane without the laser, highlights included, fraction of full scale.
    gain
        Gain of each pixel, about 1.
    """

    albedo: Image
    ambient: Image
    gain: Image

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.albedo.shape[1], self.albedo.shape[0]


def make_scene(
    image_size: tuple[int, int], options: RenderOptions, rng: np.random.Generator
) -> Scene:
    """Draw the surface and the lamp of one plane as one camera sees it.

    Parameters
    ----------
    image_size : (width, height), pixels
    options : RenderOptions
    rng : seeded generator; the same seed gives the same scene
    """
    width, height = check_image_size(image_size)
    albedo = _albedo((height, width), options, rng)
    ambient = options.ambient_level * albedo * _gradient((height, width), options, rng)
    for _ in range(options.highlights):
        _add_highlight(ambient, rng)
    gain = 1 + options.prnu * _normal(rng, (height, width))
    return Scene(albedo, ambient, gain)


def render_pair(
    uv: npt.ArrayLike | None,
    shape: npt.ArrayLike,
    scene: Scene,
    options: RenderOptions,
    rng: np.random.Generator,
) -> tuple[Picture, Picture]:
    """Take two pictures, laser on and laser off.

    Parameters
    ----------
    uv : (2,) pixels, or None
        Centre of the spot; it may lie outside the image. None: the laser does not show.
    shape : (2, 2) px^2
        Covariance of the imaged spot before the lens blur, from `spot_shape`.
    scene : Scene
    options : RenderOptions
    rng : seeded generator; draws speckle, ghost, flicker, jitter and noise

    Returns
    -------
    on, off : (height, width) arrays, uint8 or uint16

    Raises
    ------
    DataError
        ``uv`` is not finite or ``shape`` is no covariance.
    """
    light = scene.ambient.copy()
    if uv is not None:
        centre, spot = _checked_spot(uv, shape)
        _add_laser(light, centre, spot, scene.albedo, options, rng)
    lamp = 1 + options.flicker * float(rng.standard_normal())
    off = lamp * _shifted(scene.ambient, rng.normal(0.0, 1.0, 2) * options.jitter_px)
    return _expose(light, scene, options, rng), _expose(off, scene, options, rng)


def spot_shape(
    cell: Cell,
    T_base_hand: Array,
    plane: str | Sequence[str] | None,
    camera: str | Sequence[str] | None,
    laser: str | Sequence[str] | None,
    beam_radius_m: float,
) -> Array:
    """Covariance of the imaged spot of a Gaussian beam: (N, 2, 2), px^2.

    The beam's lateral position is moved by a small step along two axes across it, and the chain
    (1)-(9) tells how the pixel follows: ``J`` (2, 2), px/m. With ``sigma = beam_radius_m / 2`` the
    shape is ``sigma^2 J J'``: obliquity, distance and distortion are all in ``J``.

    Parameters
    ----------
    cell, T_base_hand, plane, camera, laser
        As in `lasercal_gtsam.projection.project`.
    beam_radius_m
        Radius at which the intensity is 1/e^2 of the centre's (the data-sheet figure), metres.

    Returns
    -------
    (N, 2, 2) array
        px^2; NaN where the spot is not seen.
    """
    if not beam_radius_m > 0:
        raise DataError(f"beam_radius_m: expected more than 0, got {beam_radius_m}")
    step = 1e-3 * beam_radius_m

    def pixels(axis: int, sign: int) -> Array:
        moved = {name: _moved(beam, axis, sign * step) for name, beam in cell.lasers.items()}
        return project(
            replace(cell, lasers=moved), T_base_hand, plane=plane, camera=camera, laser=laser
        )

    J = np.stack([(pixels(k, 1) - pixels(k, -1)) / (2 * step) for k in (0, 1)], axis=-1)
    return np.asarray((0.5 * beam_radius_m) ** 2 * J @ np.swapaxes(J, -1, -2))


def _moved(beam: Beam, axis: int, step: float) -> Beam:
    return Beam(
        beam.direction_hand, beam.point_hand + step * basis_of(beam.direction_hand)[:, axis]
    )


# --- the laser's light --------------------------------------------------------------------------


def _checked_spot(uv: npt.ArrayLike, shape: npt.ArrayLike) -> tuple[Array, Array]:
    centre, spot = np.asarray(uv, dtype=np.float64), np.asarray(shape, dtype=np.float64)
    if centre.shape != (2,) or not np.isfinite(centre).all():
        raise DataError(f"render_pair: uv: expected two finite pixels, got {uv!r}")
    if spot.shape != (2, 2) or not np.isfinite(spot).all() or np.linalg.eigvalsh(spot)[0] <= 0:
        raise DataError(
            f"render_pair: shape: expected a positive definite 2x2 matrix (px^2), got {shape!r}"
        )
    return centre, spot


def _add_laser(
    light: Image,
    centre: Array,
    shape: Array,
    albedo: Image,
    options: RenderOptions,
    rng: np.random.Generator,
) -> None:
    """Add spot, skirt and perhaps a ghost to ``light``, in place."""
    eigenvalues, axes = np.linalg.eigh(shape)
    offset = options.skirt_shift * np.sqrt(eigenvalues[1]) * axes[:, 1]
    fraction, scale = options.skirt_fraction, options.skirt_scale
    _add_spot(light, centre, shape, (1 - fraction) * options.spot_level, albedo, options, rng)
    # a skirt of power share f and scale s has f / s^2 of the peak
    level = fraction / scale**2 * options.spot_level
    _add_spot(light, centre + offset, scale**2 * shape, level, albedo, options, rng)
    if rng.uniform() < options.ghost_probability:
        away = rng.uniform(8 * np.sqrt(eigenvalues[1]), 0.5 * max(light.shape))
        angle = rng.uniform(0, 2 * np.pi)
        at = centre + away * np.array([np.cos(angle), np.sin(angle)])
        level = rng.uniform(*options.ghost_level) * options.spot_level
        _add_spot(light, at, rng.uniform(0.5, 3.0) * shape, level, albedo, options, rng)


def _add_spot(
    light: Image,
    centre: Array,
    shape: Array,
    level: float,
    albedo: Image,
    options: RenderOptions,
    rng: np.random.Generator,
) -> None:
    """Add one spot, integrated over each pixel: profile x speckle x albedo, blurred by the lens."""
    margin = int(np.ceil(4 * options.psf_sigma_px)) + 1
    box = _box(centre, shape, margin, light.shape)
    if level <= 0 or box is None:
        return
    x0, y0, x1, y1 = box
    smallest = min(np.sqrt(np.linalg.eigvalsh(shape)[0]), options.speckle_grain_px)
    k = int(np.clip(np.ceil(2 / smallest), 2, 12))
    fine = _profile(centre, shape, box, k) * _speckle(
        ((y1 - y0) * k, (x1 - x0) * k), k, options, rng
    )
    image = fine.reshape(y1 - y0, k, x1 - x0, k).mean(axis=(1, 3))
    # outside the image the albedo of its edge goes on
    rows = np.clip(np.arange(y0, y1), 0, light.shape[0] - 1)
    columns = np.clip(np.arange(x0, x1), 0, light.shape[1] - 1)
    image = level * image * albedo[np.ix_(rows, columns)]
    if options.psf_sigma_px > 0:
        image = cv2.GaussianBlur(
            image, (0, 0), options.psf_sigma_px, borderType=cv2.BORDER_CONSTANT
        )
    _paste(light, image, box)


def _speckle(
    shape: tuple[int, int], k: int, options: RenderOptions, rng: np.random.Generator
) -> Image:
    """Speckle of mean 1 on a grid of ``k`` samples a pixel (Goodman's circular Gaussian field).

    The field is white noise blurred by ``sigma``, so that the intensity's autocovariance is
    ``exp(-r^2 / (2 sigma^2))``, of area ``2 pi sigma^2`` = 1.2 grain^2. A weaker contrast is the
    same pattern over a steady part.
    """
    if options.speckle_contrast == 0:
        return np.ones(shape, dtype=np.float32)
    sigma = k * options.speckle_grain_px * np.sqrt(1.2 / (2 * np.pi))
    # blurring white noise by sigma scales its variance by 1 / (4 pi sigma^2)
    unit = np.sqrt(4 * np.pi) * sigma / np.sqrt(2)
    field = [cv2.GaussianBlur(_normal(rng, shape), (0, 0), sigma) * unit for _ in range(2)]
    pattern = field[0] ** 2 + field[1] ** 2
    return np.asarray(1 + options.speckle_contrast * (pattern - 1), dtype=np.float32)


Box = tuple[int, int, int, int]


def _box(centre: Array, shape: Array, margin: int, image_shape: tuple[int, ...]) -> Box | None:
    """Pixels ``[x0, x1) x [y0, y1)`` that the spot can reach; None where it is out of sight."""
    reach = _REACH * np.sqrt(np.diag(shape)) + margin
    limit = np.array([image_shape[1], image_shape[0]])
    low = np.maximum(np.floor(centre - reach), -margin).astype(int)
    high = np.minimum(np.ceil(centre + reach) + 1, limit + margin).astype(int)
    if np.any(high <= 0) or np.any(low >= limit) or np.any(high <= low):
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _profile(centre: Array, shape: Array, box: Box, k: int) -> Image:
    """Gaussian of peak 1 on ``k`` x ``k`` samples in each pixel of the box."""
    x0, y0, x1, y1 = box
    # pixel i covers [i - 0.5, i + 0.5]: its samples lie at i - 0.5 + (j + 0.5) / k
    dx = x0 - 0.5 + (np.arange((x1 - x0) * k) + 0.5) / k - centre[0]
    dy = y0 - 0.5 + (np.arange((y1 - y0) * k) + 0.5) / k - centre[1]
    (a, b), (_, c) = np.linalg.inv(shape)
    # exp(-a dx^2/2 - b dx dy - c dy^2/2), in float64 until the exponential is done
    exponent = a * dx[None, :] ** 2 + 2 * b * dx[None, :] * dy[:, None] + c * dy[:, None] ** 2
    return np.asarray(np.exp(-0.5 * exponent), dtype=np.float32)


def _paste(light: Image, image: Image, box: Box) -> None:
    """Add the part of ``image`` that lies inside ``light``."""
    x0, y0, x1, y1 = box
    height, width = light.shape
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    light[top:bottom, left:right] += image[top - y0 : bottom - y0, left - x0 : right - x0]


# --- surface, lamp, camera ----------------------------------------------------------------------


def _albedo(shape: tuple[int, int], options: RenderOptions, rng: np.random.Generator) -> Image:
    """Fine and coarse structure of equal strength, and printed patches with edges of one pixel."""
    fine = cv2.GaussianBlur(_normal(rng, shape), (0, 0), 1.0)
    coarse = cv2.GaussianBlur(_normal(rng, shape), (0, 0), 8.0)
    structure = (fine / fine.std() + coarse / coarse.std()) / np.sqrt(2)
    albedo = np.asarray(1 + options.texture * structure, dtype=np.float32)
    height, width = shape
    factor = np.ones(shape, dtype=np.float32)
    for _ in range(options.patches):
        x, y = (int(v) for v in rng.uniform(0, 1, 2) * (width, height))
        w, h = (int(v) for v in rng.uniform(0.05, 0.3, 2) * (width, height))
        factor[y : y + h, x : x + w] *= float(rng.uniform(0.6, 1.4))
    albedo = np.clip(albedo * cv2.GaussianBlur(factor, (0, 0), 0.7), 0.05, 2.0)
    return np.asarray(albedo, dtype=np.float32)


def _gradient(shape: tuple[int, int], options: RenderOptions, rng: np.random.Generator) -> Image:
    """Linear brightness of mean 1 with the asked change from edge to edge in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    y = np.linspace(-0.5, 0.5, shape[0], dtype=np.float32)[:, None]
    x = np.linspace(-0.5, 0.5, shape[1], dtype=np.float32)[None, :]
    return np.asarray(
        1 + np.float32(options.ambient_gradient) * (np.cos(angle) * x + np.sin(angle) * y),
        dtype=np.float32,
    )


def _add_highlight(ambient: Image, rng: np.random.Generator) -> None:
    """Add one static bright spot, in place."""
    centre = rng.uniform(0.02, 0.98, 2) * (ambient.shape[1], ambient.shape[0])
    shape = np.diag(rng.uniform(1.2, 4.0, 2) ** 2)
    level = rng.uniform(0.3, 1.5)
    box = _box(centre, shape, 0, ambient.shape)
    if box is not None:
        _paste(ambient, np.float32(level) * _profile(centre, shape, box, 1), box)


def _shifted(image: Image, shift: Array) -> Image:
    """Image moved by a sub-pixel shift, edges repeated."""
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (image.shape[1], image.shape[0])
    moved: Any = cv2.warpAffine(
        image, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, dtype=np.float32)


def _expose(
    light: Image, scene: Scene, options: RenderOptions, rng: np.random.Generator
) -> Picture:
    """Light (1 = saturation) to pixel values: gain, noise, quantisation, clipping."""
    electrons = options.full_well_e * np.maximum(light * scene.gain, 0)
    noise = np.sqrt(electrons + options.read_noise_e**2) * _normal(rng, light.shape)
    level = (electrons + noise) * (options.full_scale / options.full_well_e)
    level = np.clip(np.rint(level), 0, options.full_scale)
    if options.bits == 8:
        return np.asarray(level, dtype=np.uint8)
    return np.asarray(level, dtype=np.uint16)


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Image:
    return rng.standard_normal(shape, dtype=np.float32)
