"""Rendered pictures with known centres, for the tests of the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect import Detection, DetectionOptions, detect_spot
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.simulate.render import RenderOptions, make_scene, render_pair

# a dim, even wall and a spot without speckle; each case adds its own trouble
PLAIN = RenderOptions(
    spot_level=0.6,
    speckle_contrast=0.0,
    speckle_grain_px=1.0,
    psf_sigma_px=0.5,
    skirt_fraction=0.0,
    ambient_level=0.1,
    ambient_gradient=0.0,
    texture=0.0,
    patches=0,
    highlights=0,
    ghost_probability=0.0,
    flicker=0.0,
    jitter_px=0.0,
)


def ellipse(minor: float, ratio: float, angle: float) -> Array:
    """Covariance of a spot with sigmas ``minor`` and ``ratio * minor``."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R @ np.diag([(minor * ratio) ** 2, minor**2]) @ R.T


@dataclass(frozen=True)
class Outcome:
    """Detections of n pictures with the true centres."""

    detections: list[Detection]
    truth: Array

    @property
    def used(self) -> np.ndarray:
        return np.array([d.usable for d in self.detections])

    @property
    def errors(self) -> Array:
        """Centre errors of the used spots (m, 2), px."""
        uv = np.array([d.uv for d in self.detections])
        return (uv - self.truth)[self.used]

    @property
    def rms(self) -> float:
        """Error per axis of the used spots, px."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def worst(self) -> float:
        """Largest distance between a used spot and the truth, px."""
        return float(np.max(np.hypot(*self.errors.T)))

    @property
    def nees(self) -> Array:
        """Squared errors in units of their covariance (m,); chi-square with 2 degrees."""
        cov = np.array(
            [d.cov_uv for d, used in zip(self.detections, self.used, strict=True) if used]
        )
        return np.einsum("ni,nij,nj->n", self.errors, np.linalg.inv(cov), self.errors)

    @property
    def inside95(self) -> float:
        """Share of the used spots within their 95 % ellipse."""
        return float(np.mean(self.nees < 5.991))

    def count(self, verdict: str) -> int:
        """Number of pictures with a verdict."""
        return sum(d.verdict == verdict for d in self.detections)


def run(
    options: RenderOptions,
    n: int,
    *,
    sigma: float | tuple[float, float] = 2.5,
    ratio: float | tuple[float, float] = 1.0,
    size: tuple[int, int] = (64, 64),
    spread: float | None = 0.5,
    off: bool = True,
    detection: DetectionOptions | None = None,
    seed: int = 5,
) -> Outcome:
    """Render and detect n pictures, each with its own surface.

    The spot lies within ``spread`` px of the middle, or anywhere 20 px inside if that is None;
    ``sigma`` and ``ratio`` are values or ranges.
    """
    rng = np.random.default_rng(seed)
    detections, truth = [], []
    for _ in range(n):
        scene = make_scene(size, options, rng)
        half = np.array(size) / 2 - 20 if spread is None else np.full(2, spread)
        uv = np.array(size) / 2 + rng.uniform(-1, 1, 2) * half
        shape = ellipse(_draw(sigma, rng), _draw(ratio, rng), rng.uniform(0, np.pi))
        lit, dark = render_pair(uv, shape, scene, options, rng)
        detections.append(detect_spot(lit, dark if off else None, detection))
        truth.append(uv)
    return Outcome(detections, np.array(truth))


def _draw(value: float | tuple[float, float], rng: np.random.Generator) -> float:
    return float(rng.uniform(*value)) if isinstance(value, tuple) else value
