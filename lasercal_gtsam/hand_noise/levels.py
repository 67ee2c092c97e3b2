"""Noise levels that nobody stated: the pixels', the hand's, or both, from the residuals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.calibration import NoiseLevel
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import expansion, prior_factor, spread_columns, state_from_cell
from lasercal_gtsam.hand_noise.components import Block, Components, Prior, variance_components
from lasercal_gtsam.hand_noise.elimination import (
    HandNoise,
    Mask,
    block_diagonal,
    joint_derivative,
    moved_hands,
    stops_by_size,
)
from lasercal_gtsam.observations import Index, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.solve import Solution
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

# degrees of freedom below which residuals say nothing about several noise levels
_FEWEST_DOF = 20
# smallest pixel sigma that is told from zero, and the largest that is looked for (px)
_SIGMA_RANGE_PX = (1e-3, 1e3)
_SIGMA_STEPS = 40
# half a 95 % interval in standard errors
_Z95 = 1.959963984540054
# beyond this correlation two levels are hardly told apart; beyond this share of its value the
# standard error of a level says that it is hardly known
_ENTANGLED, _VAGUE = -0.9, 0.5

_PIXEL = "sigma_px"
_SHOWN = {
    _PIXEL: ("the pixels' sigma", 1.0, "px"),
    "hand_sigma_m": ("the hand's translation", MM_PER_M, "mm"),
    "hand_sigma_rad": ("the hand's rotation", DEG_PER_RAD, "deg"),
}


@dataclass(frozen=True, eq=False)
class PixelNoise:
    """What is known of the pixels: ``stated`` (N, 2, 2) px^2, zero where ``missing`` (N,)."""

    stated: Array
    missing: Mask

    @classmethod
    def of(cls, observations: Observations, options: CalibrationOptions) -> PixelNoise:
        """The spots' own covariances, or ``options.sigma_px``, or nothing."""
        cov = observations.cov_uv
        unknown = np.isnan(cov[:, 0, 0])
        general = 0.0 if options.sigma_px is None else options.sigma_px**2
        stated = np.where(unknown[:, None, None], general * np.eye(2), cov)
        return cls(stated, unknown & (options.sigma_px is None))

    def covariance(self, sigma_px: float) -> Array:
        """(N, 2, 2) px^2 with the missing sigma filled in."""
        return self.stated + sigma_px**2 * self.unit

    @property
    def unit(self) -> Array:
        """(N, 2, 2): its derivative by the missing variance."""
        return np.asarray(np.where(self.missing, 1.0, 0.0)[:, None, None] * np.eye(2))


@dataclass(frozen=True)
class Levels:
    """Noise levels in use, and what was found of those that nobody stated."""

    sigma_px: float
    hand: HandNoise
    found: tuple[NoiseLevel, ...] = ()
    words: tuple[str, ...] = ()

    def differ(self, other: Levels) -> float:
        """Largest change of a level that was found, in its standard errors."""
        pairs = zip(self.found, other.found, strict=False)
        return max((abs(a.value - b.value) / _scale(a) for a, b in pairs), default=np.inf)


@dataclass(frozen=True, eq=False)
class Residuals:
    """The spots at their corrected hand poses: ``B`` (N, 2, 6), ``r`` (N, 2) as of `linearized`."""

    observations: Observations
    eta: Array
    B: Array
    r: Array
    kept: Mask

    def stops(self) -> Iterator[Index]:
        """Spots kept, as (G, k) for each k."""
        return stops_by_size(self.observations, self.kept)


def missing_sigma(spots: Residuals, pixels: PixelNoise, hand: HandNoise, dof: int) -> float:
    """Pixel sigma with which ``r^T S^-1 r = dof``, beside a stated noise of the hand (px)."""
    parts = []
    for members in spots.stops():
        B = joint_derivative(spots.B, members)
        fixed = block_diagonal(pixels.stated[members])
        fixed += np.einsum("gij,j,gkj->gik", B, hand.variances, B)
        unit = block_diagonal(pixels.unit[members])
        parts.append((spots.r[members].reshape(len(members), -1), fixed, unit))
    low, high = np.log(_SIGMA_RANGE_PX)
    for _ in range(_SIGMA_STEPS):
        middle = 0.5 * (low + high)
        chi2 = 0.0
        for r, fixed, unit in parts:
            S = fixed + np.exp(2.0 * middle) * unit
            chi2 += float(np.einsum("gi,gi->", r, np.linalg.solve(S, r[..., None])[..., 0]))
        low, high = (middle, high) if chi2 > dof else (low, middle)
    return float(np.exp(0.5 * (low + high)))


def estimated_levels(
    spots: Residuals,
    pixels: PixelNoise,
    solution: Solution,
    options: CalibrationOptions,
    last: Levels | None,
) -> Levels:
    """The levels in ``options.estimate_noise``, and a missing pixel sigma, together.

    Parameters
    ----------
    spots : at the hand poses corrected so far
    pixels : what is stated of the pixels
    solution : the cell so far, and what is free in it
    options : which levels; the others are as stated
    last : levels found in the round before, to begin with

    Raises
    ------
    DataError
        Too few spots.
    """
    names = (*((_PIXEL,) if pixels.missing[spots.kept].any() else ()), *options.estimate_noise)
    blocks, prior = _blocks(spots, pixels, solution, names, HandNoise.of(options))
    rows, unknowns = 2 * int(spots.kept.sum()), blocks[0].A.shape[2]
    if rows - unknowns < _FEWEST_DOF:
        raise DataError(
            f"options.estimate_noise: {rows} residuals and {unknowns} unknowns leave "
            f"{rows - unknowns} degrees of freedom, too few to estimate {len(names)} noise levels "
            f"from ({_FEWEST_DOF} are the least): state the noise, or add spots"
        )
    start = _first_guess(blocks) if last is None else np.array([x.value**2 for x in last.found])
    found = variance_components(blocks, start, prior)
    levels = _noise_levels(names, found)
    value = {level.name: level.value for level in levels}
    hand = HandNoise(
        value.get("hand_sigma_m", options.hand_sigma_m),
        value.get("hand_sigma_rad", options.hand_sigma_rad),
    )
    sigma_px = max(value.get(_PIXEL, 1.0), _SIGMA_RANGE_PX[0])
    return Levels(sigma_px, hand, levels, _words(levels, found))


def _blocks(
    spots: Residuals,
    pixels: PixelNoise,
    solution: Solution,
    names: tuple[str, ...],
    stated: HandNoise,
) -> tuple[list[Block], Prior | None]:
    problem = solution.problem.anchored(solution.cell)
    E = expansion(problem.chart.aspects, problem.free)
    prior = None
    if problem.holds.priors:
        factor = prior_factor(problem.chart, problem.holds, problem.start)
        J, minus_e = factor.linearize(problem.start_values()).jacobian()
        prior = Prior(J @ E, -minus_e)
    A = _derivative(spots, solution) @ E
    hands = (slice(0, 3), "hand_sigma_m"), (slice(3, 6), "hand_sigma_rad")
    stated_variances = stated.variances
    blocks = []
    for members in spots.stops():
        B = joint_derivative(spots.B, members)
        unit = block_diagonal(pixels.unit[members])
        fixed = block_diagonal(pixels.stated[members]) + _SIGMA_RANGE_PX[0] ** 2 * unit
        parts = [unit] if _PIXEL in names else []
        for axes, name in hands:
            part = B[..., axes] @ np.swapaxes(B[..., axes], 1, 2)
            if name in names:
                parts.append(part)
            else:
                fixed += stated_variances[axes.start] * part
        count = len(members)
        blocks.append(
            Block(
                spots.r[members].reshape(count, -1),
                A[members].reshape(count, B.shape[1], -1),
                fixed,
                np.array(parts),
            )
        )
    return blocks, prior


def _derivative(spots: Residuals, solution: Solution) -> Array:
    """(N, 2, n) px per unit: derivative of the spots by all coordinates of the cell."""
    seen = spots.observations
    batch = SpotBatch.from_arrays(
        seen.uv,
        np.broadcast_to(np.eye(2), (len(seen), 2, 2)),
        moved_hands(seen.T_base_hand, spots.eta),
        seen.camera_index,
        seen.laser_index,
        seen.plane_index,
    )
    rows = batch.rows(state_from_cell(solution.cell))[..., :-1]
    rows[~spots.kept] = 0.0  # maybe impossible
    return spread_columns(rows, solution.cell, seen)


def _first_guess(blocks: list[Block]) -> Array:
    """Every component as if it explained its share of the residuals."""
    rows = sum(block.r.size for block in blocks)
    dof = max(rows - blocks[0].A.shape[2], 1)
    square = sum(float(np.sum(block.r**2)) for block in blocks) / dof
    sizes = sum(np.einsum("jgaa->j", block.parts) for block in blocks) / rows
    return np.asarray(square / len(sizes) / np.maximum(sizes, 1e-300))


def _noise_levels(names: tuple[str, ...], found: Components) -> tuple[NoiseLevel, ...]:
    """Sigmas of the variances, their standard errors and 95 % intervals."""
    levels = []
    for name, theta, error in zip(names, found.theta, found.standard_errors, strict=True):
        sigma = float(np.sqrt(theta))
        levels.append(
            NoiseLevel(
                name,
                sigma,
                float(error / (2.0 * sigma)) if sigma > 0 else float("nan"),
                float(np.sqrt(max(theta - _Z95 * error, 0.0))),
                float(np.sqrt(theta + _Z95 * error)),
            )
        )
    return tuple(levels)


def _scale(level: NoiseLevel) -> float:
    """Half the width of its interval, as a unit to measure changes in."""
    width = level.high - level.low
    return max(0.5 * width / _Z95, 1e-12) if np.isfinite(width) else max(level.value, 1e-12)


def _words(levels: tuple[NoiseLevel, ...], found: Components) -> tuple[str, ...]:
    """What must be said beside the numbers."""
    words = []
    if not found.settled:
        words.append("the estimate of the noise levels did not settle: state what is known of them")
    for level in levels:
        what, factor, unit = _SHOWN[level.name]
        if not np.isfinite(level.high):
            words.append(f"the spots say nothing about {what}: state it, or leave it out")
        elif level.value == 0.0 or level.standard_error > _VAGUE * level.value:
            words.append(
                f"{what} is hardly determined by these spots: {factor * level.value:.2g} {unit}, "
                f"between {factor * level.low:.2g} and {factor * level.high:.2g} (95 %)"
            )
    correlation = found.correlation
    for i, a in enumerate(levels):
        for j, b in enumerate(levels[:i]):
            if correlation[i, j] < _ENTANGLED:
                words.append(
                    f"{_SHOWN[b.name][0]} and {_SHOWN[a.name][0]} can hardly be told apart "
                    f"(correlation {correlation[i, j]:.2f}): what they do together is known, and "
                    "the sigmas of the cell need no more than that"
                )
    return tuple(words)
