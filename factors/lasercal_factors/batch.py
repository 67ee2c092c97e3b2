"""Spots of a cell, whitened and sorted for the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lasercal_factors import hand_kernels, kernels
from lasercal_factors.arrays import Array, Index, Spots, State
from lasercal_factors.correlated import Correlation, Division, decorrelated
from lasercal_factors.errors import FactorError

LossName = Literal["none", "huber", "cauchy", "geman-mcclure"]
IMPOSSIBLE = (
    "linearised where a beam misses its plane, a spot lies behind its camera, or the distortion "
    "folds; check the start value"
)
LOSSES: dict[str, int] = {"none": 0, "huber": 1, "cauchy": 2, "geman-mcclure": 3}


@dataclass(frozen=True)
class Loss:
    """Robust loss on the whitened length of a spot's residual; ``threshold`` in sigmas."""

    name: LossName = "none"
    threshold: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in LOSSES or not self.threshold > 0:
            raise FactorError(f"loss: one of {', '.join(LOSSES)}, threshold > 0; got {self}")


class HandPrior(NamedTuple):
    """Noise of hand poses: ``variances`` (6,), and ``fixed`` (N,) of the spots as they are held."""

    variances: Array
    fixed: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SpotBatch:
    """Spots sorted into blocks of equal camera, laser and plane; build it with `from_arrays`.

    Attributes
    ----------
    spots : arrays for the kernels
    order : (N,) input index of each spot held
    size : number of spots given (some may have been left out by `weighted`)
    correlations : groups of spots whose errors are not independent
    hand : noise of the hand poses, which are eliminated wherever the batch is evaluated: see
        `with_noisy_hands`
    """

    spots: Spots
    order: Index
    size: int
    correlations: tuple[Correlation, ...] = ()
    hand: HandPrior | None = None

    @classmethod
    def from_arrays(
        cls,
        uv: npt.ArrayLike,
        cov_uv: npt.ArrayLike,
        T_base_hand: npt.ArrayLike,
        camera: npt.ArrayLike,
        laser: npt.ArrayLike,
        plane: npt.ArrayLike,
    ) -> SpotBatch:
        """Sort and whiten.

        Parameters
        ----------
        uv : (N, 2) px
        cov_uv : (N, 2, 2) px^2, positive definite
        T_base_hand : (N, 4, 4), metres
        camera, laser, plane : (N,) indices into the keys of `CellKeys`

        Raises
        ------
        FactorError
            On shapes that do not fit, no spots, or a covariance that is not positive definite.
        """
        uv, T = np.asarray(uv, dtype=np.float64), np.asarray(T_base_hand, dtype=np.float64)
        count = len(uv)
        who = np.column_stack([np.asarray(x, dtype=np.int64) for x in (camera, laser, plane)])
        if not count or uv.shape != (count, 2) or T.shape != (count, 4, 4) or len(who) != count:
            raise FactorError(
                f"spots: uv {uv.shape}, T_base_hand {T.shape}, {len(who)} indices; expected "
                "(N, 2), (N, 4, 4) and N with N > 0"
            )
        order = np.lexsort((who[:, 2], who[:, 1], who[:, 0]))
        whitening = whitening_from_covariance(np.asarray(cov_uv, dtype=np.float64))
        pixels = np.concatenate([uv, whitening], axis=1)[order].T
        hands = np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]], axis=1)[order].T
        spots = Spots(
            np.ascontiguousarray(pixels), np.ascontiguousarray(hands), _blocks(who[order])
        )
        return cls(spots, order, count)

    def correlated(self, spots: npt.ArrayLike, cov: npt.ArrayLike) -> SpotBatch:
        """The same with groups of spots that have errors in common.

        Parameters
        ----------
        spots : (G, k) input indices; no spot in two groups
        cov : (G, 2k, 2k) px^2, joint covariance of their pixels; each spot's own block is the
            ``cov_uv`` that it was given

        Raises
        ------
        FactorError
            On shapes that do not fit, a spot twice, or a spot that was left out.
        """
        groups = np.asarray(spots, dtype=np.int64)
        joint = np.asarray(cov, dtype=np.float64)
        if groups.ndim != 2 or joint.shape != (len(groups), *(2 * groups.shape[1],) * 2):
            raise FactorError(
                f"correlated spots: groups {groups.shape}, covariances {joint.shape}; expected "
                "(G, k) and (G, 2k, 2k)"
            )
        named = np.concatenate([groups.ravel(), *(c.spots.ravel() for c in self.correlations)])
        if len(np.unique(named)) != len(named) or not self.used[named].all():
            raise FactorError("correlated spots: one is in two groups, or was left out")
        whitening = np.zeros((self.size, 3))
        whitening[self.order] = self.spots.pixels[2:].T
        found = Correlation.of(groups, joint, whitening)
        return replace(self, correlations=(*self.correlations, found))

    def with_noisy_hands(
        self, variances: npt.ArrayLike, fixed: npt.ArrayLike | None = None
    ) -> SpotBatch:
        """The same with every hand pose an unknown, eliminated in closed form at each state.

        What a state costs is then the least over all hand poses; residuals are those of the
        commanded poses to first order about the likeliest, whitened with pixel and hand together.

        Parameters
        ----------
        variances : (6,) of translation in the base (m^2) and rotation in the hand (rad^2)
        fixed : (N,) booleans: spots, input order, judged at the commanded pose

        Raises
        ------
        FactorError
            On shapes that do not fit, a negative variance, or correlated spots.
        """
        hand = np.array(variances, dtype=np.float64)
        mask = np.zeros(self.size, np.bool_) if fixed is None else np.array(fixed, np.bool_)
        if hand.shape != (6,) or not np.all(hand >= 0) or mask.shape != (self.size,):
            raise FactorError(
                f"noisy hands: expected 6 variances >= 0 and ({self.size},) booleans, got {hand}, "
                f"{mask.shape}"
            )
        if self.correlations:
            raise FactorError("noisy hands: for spots that are correlated already")
        return replace(self, hand=HandPrior(hand, mask[self.order]))

    def at(self, state: State) -> SpotBatch:
        """The batch with its hand poses corrected for a state, for which alone it is meant."""
        if self.hand is None:
            return self
        return replace(self, spots=self._seen(state), hand=None)

    def _seen(self, state: State) -> Spots:
        if self.hand is None:
            return self.spots
        spots: Spots = hand_kernels.hands_corrected(
            self.spots, state, *self.hand, np.zeros((len(self.order), 6))
        )
        return spots

    def __len__(self) -> int:
        return self.size

    def weighted(self, weights: npt.ArrayLike) -> SpotBatch:
        """Multiply the information of each spot by a weight (N,), input order.

        Spots of weight zero are left out altogether, even if no spot can be where they are.
        """
        given = np.asarray(weights, dtype=np.float64)
        if given.shape != (self.size,) or not np.all(given >= 0):
            raise FactorError(f"weights: expected ({self.size},) numbers >= 0, got {given.shape}")
        weight = given[self.order]
        keep = weight > 0
        if self.hand is not None and np.any(weight[keep] != 1):
            raise FactorError("weights: other than 0 and 1 for spots with noisy hands")
        if not keep.any():
            raise FactorError("weights: every spot has weight zero")
        blocks = self.spots.blocks
        who = np.repeat(blocks[:, :3], blocks[:, 4] - blocks[:, 3], axis=0)
        pixels = self.spots.pixels[:, keep]
        pixels[2:] *= np.sqrt(weight[keep])
        spots = Spots(pixels, np.ascontiguousarray(self.spots.hands[:, keep]), _blocks(who[keep]))
        correlations = tuple(c.weighted(given) for c in self.correlations)
        hand = self.hand and HandPrior(self.hand.variances, self.hand.fixed[keep])
        return SpotBatch(spots, self.order[keep], self.size, correlations, hand)

    def scaled(self, scale: float) -> SpotBatch:
        """Return the same spots with every sigma multiplied by ``scale``."""
        pixels = self.spots.pixels.copy()
        pixels[2:] /= scale
        hand = self.hand and self.hand._replace(variances=scale**2 * self.hand.variances)
        return replace(self, spots=self.spots._replace(pixels=pixels), hand=hand)

    @cached_property
    def division(self) -> Division:
        """The spots in two parts: by themselves, and correlated ones."""
        return Division.of(self)

    def decorrelated(self, rows: Array) -> Array:
        """Whitened rows (N, 2, m) in input order, those of correlated spots made independent.

        Rows of spots left out are zero then.
        """
        if not self.correlations:
            return rows
        return decorrelated(np.where(self.used[:, None, None], rows, 0.0), self.correlations)

    @cached_property
    def used(self) -> npt.NDArray[np.bool_]:
        """(N,) booleans in input order: spots that are not left out."""
        out = np.zeros(self.size, dtype=np.bool_)
        out[self.order] = True
        return out

    def residuals(self, state: State) -> Array:
        """Predicted minus seen pixel in input order, (N, 2); NaN where impossible or left out."""
        out = np.full((self.size, 2), np.nan)
        out[self.order] = kernels.residuals(self._seen(state), state)
        return out

    def whitened_lengths(self, state: State) -> Array:
        """Length of each whitened residual (sigmas), input order, (N,); NaN as in `residuals`.

        Each spot by itself, whatever it has in common with others.
        """
        spots = self._seen(state)
        du, dv = kernels.residuals(spots, state).T
        w00, w01, w11 = spots.pixels[2:]
        out = np.full(self.size, np.nan)
        out[self.order] = np.hypot(w00 * du + w01 * dv, w11 * dv)
        return out

    def rows(self, state: State) -> Array:
        """Whitened Jacobian and residual of each spot in input order, (N, 2, 23).

        Each spot by itself; `decorrelated` makes correlated ones independent.
        """
        out = np.full((self.size, 2, kernels.COLUMNS), np.nan)
        out[self.order] = kernels.rows(self._seen(state), state)
        return out

    def total_loss(self, state: State, loss: Loss) -> float:
        """Sum of the losses (twice the graph's error); inf where a spot cannot be."""
        if self.correlations:
            refuse_loss(loss)
            return self.division.total_loss(state)
        return float(
            kernels.total_loss(self._seen(state), state, LOSSES[loss.name], loss.threshold)
        )


def refuse_loss(loss: Loss) -> None:
    """Raise `FactorError` where correlated spots, or noisy hands, are to be weighed by a loss."""
    if loss.name != "none":
        raise FactorError(
            f"the {loss.name} loss weighs spots one by one as they are; not correlated ones, nor "
            "those with noisy hands"
        )


def _blocks(who: Index) -> Index:
    """Blocks of equal rows of ``who`` (N, 3), which is sorted."""
    first = np.flatnonzero(np.append(True, np.any(who[1:] != who[:-1], axis=1)))
    return np.column_stack([who[first], first, np.append(first[1:], len(who))])


def whitening_from_covariance(cov: Array) -> Array:
    """(N, 3) ``w00, w01, w11`` of upper triangular ``W`` with ``W.T W = inv(cov)``.

    Raises
    ------
    FactorError
        A covariance is not positive definite; names the first.
    """
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    with np.errstate(all="ignore"):
        det = a * c - b * b
        w00 = np.sqrt(c / det)
        out = np.column_stack([w00, -b / (det * w00), 1 / np.sqrt(c)])
    bad = ~((det > 0) & (c > 0) & np.isfinite(out).all(axis=1))
    if bad.any():
        k = int(np.argmax(bad))
        raise FactorError(f"cov_uv[{k}]: not positive definite: {cov[k].tolist()}")
    return out
