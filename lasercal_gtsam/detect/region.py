"""The pixels that belong to a spot: connected light above a share of its peak, with moments."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lasercal_gtsam.detect.candidates import FINE, Candidate
from lasercal_gtsam.detect.difference import Image, Mask
from lasercal_gtsam.frozen import Array

LEVEL = 0.2  # of the peak: what is above belongs to the spot
_FIRST_HALF = 40  # px
_MIN_SIGMA = 0.35


@dataclass(frozen=True, eq=False)
class Region:
    """The connected pixels above a share of the peak, and their moments.

    ``box`` is (u0, v0, width, height), ``mask`` (height, width) inside it, ``centroid`` that of the
    light above the contour, ``shape`` the covariance of the Gaussian with such a region.
    """

    box: tuple[int, int, int, int]
    mask: Mask
    area: int
    centroid: Array
    shape: Array


def find_region(blurred: Image, candidate: Candidate, level: float = LEVEL) -> Region:
    """Pixels of the blurred difference above ``level * candidate.peak`` that connect to it.

    A Gaussian's region is an ellipse of semi-axes ``sigma sqrt(-2 ln level)``, whose second moment
    is a quarter of their squares: that gives ``shape``, the blur taken out.
    """
    threshold = level * candidate.peak
    (u0, v0, width, height), mask = _connected(blurred, candidate, threshold)
    v, u = np.nonzero(mask)
    weight = blurred[v0 : v0 + height, u0 : u0 + width][mask].astype(np.float64) - threshold
    u, v = u + u0, v + v0
    centroid = np.array([weight @ u, weight @ v]) / weight.sum()
    moment = np.cov(np.stack([u, v]), bias=True) if u.size > 1 else np.zeros((2, 2))
    shape = moment / (0.5 * np.log(1 / level)) - FINE**2 * np.eye(2)
    return Region(
        (u0, v0, width, height), mask, int(u.size), centroid, _at_least(shape, _MIN_SIGMA)
    )


def _connected(
    blurred: Image, candidate: Candidate, threshold: float
) -> tuple[tuple[int, int, int, int], Mask]:
    """Bounding box and mask in it; looked for in a surrounding that grows until it holds all."""
    height, width = blurred.shape
    half = _FIRST_HALF
    while True:
        left, top = max(candidate.u - half, 0), max(candidate.v - half, 0)
        right, bottom = min(candidate.u + half + 1, width), min(candidate.v + half + 1, height)
        above = blurred[top:bottom, left:right] > threshold
        _, labels = cv2.connectedComponents(above.view(np.uint8), connectivity=8)
        mask = labels == labels[candidate.v - top, candidate.u - left]
        u0, v0, w, h = cv2.boundingRect(mask.view(np.uint8))
        cut = (
            (u0 == 0 and left > 0)
            or (v0 == 0 and top > 0)
            or (u0 + w == right - left and right < width)
            or (v0 + h == bottom - top and bottom < height)
        )
        if not cut:
            return (left + u0, top + v0, w, h), mask[v0 : v0 + h, u0 : u0 + w]
        half *= 4


def _at_least(shape: Array, sigma: float) -> Array:
    values, axes = np.linalg.eigh(shape)
    return np.asarray((axes * np.maximum(values, sigma**2)) @ axes.T)


def squared_distance(u: Array, v: Array, centre: Array, shape: Array) -> Array:
    """Mahalanobis distance, squared, of pixels from a spot."""
    (a, b), (_, c) = np.linalg.inv(shape)
    du, dv = u - centre[0], v - centre[1]
    return np.asarray(a * du * du + 2 * b * du * dv + c * dv * dv)
