"""Where in the difference a spot could be: blobs above noise and clutter, strongest first."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from lasercal_gtsam.detect.difference import Difference, Image, Mask, clipped_sigma

FINE, MIDDLE, COARSE = 1.2, 3.0, 9.0  # px; differences of Gaussians: fine-middle, middle-coarse
_SAMPLES = 40_000


@dataclass(frozen=True)
class Candidate:
    """A blob: pixel of its maximum and height there, after a blur of `FINE` pixels."""

    u: int
    v: int
    peak: float


@dataclass(frozen=True, eq=False)
class Candidates:
    """All blobs of a picture, strongest first, and the blurred difference they were ranked by."""

    ranked: tuple[Candidate, ...]
    blurred: Image


def find_candidates(difference: Difference, threshold_sigmas: float) -> Candidates:
    """Blobs that rise above the noise and above what shift and flicker could leave over.

    A pixel belongs to a blob where one of two differences of Gaussians exceeds
    ``threshold_sigmas`` times its own noise plus three times the clutter. Ranked by the peak of
    the blurred difference: the flux would favour wide weak stray light.
    """
    light = difference.light
    fine, middle = _blur(light, FINE), _blur(light, MIDDLE)
    coarse = _coarse_blur(light)
    mask = np.zeros(light.shape, dtype=bool)
    for response, gain in (
        (fine - middle, _noise_gain(FINE, MIDDLE)),
        (middle - coarse, _noise_gain(MIDDLE, COARSE)),
    ):
        sigma = max(gain * difference.noise, _spread(response))
        mask |= response > threshold_sigmas * sigma + 3 * difference.clutter
    # a bump in a hollow, or the rim of one, has no light of its own
    mask &= fine > threshold_sigmas * _noise_gain(FINE) * difference.noise
    return Candidates(_ranked(mask, fine), fine)


def _ranked(mask: Mask, blurred: Image) -> tuple[Candidate, ...]:
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    if count < 2:
        return ()
    v, u = np.nonzero(mask)
    label, height = labels[v, u], blurred[v, u]
    order = np.lexsort((u, v, -height, label))
    first = order[np.r_[True, np.diff(label[order]) > 0]]
    found = [Candidate(int(u[i]), int(v[i]), float(height[i])) for i in first]
    return tuple(sorted(found, key=lambda c: (-c.peak, c.v, c.u)))


def _blur(image: Image, sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


def _coarse_blur(image: Image) -> Image:
    """Blur by `COARSE` at a quarter of the resolution: a wide kernel costs its width otherwise."""
    height, width = image.shape
    small = cv2.resize(
        image, (max(width // 4, 1), max(height // 4, 1)), interpolation=cv2.INTER_AREA
    )
    small = cv2.GaussianBlur(small, (0, 0), COARSE / 4, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def _noise_gain(inner: float, outer: float = math.inf) -> float:
    """Standard deviation of white unit noise after a Gaussian blur, or a difference of two."""
    variance = 1 / inner**2 + 1 / outer**2 - 4 / (inner**2 + outer**2)
    return math.sqrt(variance / (4 * math.pi))


def _spread(response: Image) -> float:
    """Typical size of the response over the picture: noise and residual structure together."""
    stride = max(1, int(np.sqrt(response.size / _SAMPLES)))
    return clipped_sigma(response[::stride, ::stride].ravel())
