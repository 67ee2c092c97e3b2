"""Spots whose errors are correlated: several seen from one standing of a noisy hand.

Every spot keeps its own whitening, as if it were alone; what they have in common is the
correlation ``C`` of the residuals whitened like that (unit 2x2 blocks on its diagonal). Multiplied
by ``C^-1/2``, the symmetric root, so that no order of the spots matters, their rows count like
independent ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lasercal_factors import kernels
from lasercal_factors.arrays import Array, Index, Spots, State
from lasercal_factors.errors import FactorError

if TYPE_CHECKING:
    from lasercal_factors.batch import SpotBatch


@dataclass(frozen=True, eq=False)
class Correlation:
    """G groups of k spots each, correlated within a group.

    Attributes
    ----------
    spots : (G, k) input indices
    matrix : (G, 2k, 2k) correlation of the residuals, each spot whitened by itself
    """

    spots: Index
    matrix: Array

    @cached_property
    def root(self) -> Array:
        """(G, 2k, 2k) symmetric ``C^-1/2``.

        Raises
        ------
        FactorError
            A matrix is not positive definite.
        """
        values, vectors = np.linalg.eigh(self.matrix)
        bad = ~(values[:, 0] > 0)
        if bad.any():
            group = self.spots[int(np.argmax(bad))].tolist()
            raise FactorError(f"spots {group}: their joint covariance is not positive definite")
        return np.asarray((vectors / np.sqrt(values)[:, None]) @ np.swapaxes(vectors, 1, 2))

    @classmethod
    def of(cls, spots: Index, cov: Array, whitening: Array) -> Correlation:
        """From joint covariances (G, 2k, 2k) px^2 and the whitening (N, 3) of every spot."""
        count, k = spots.shape
        W = np.zeros((count, k, 2, k, 2))
        each = np.arange(k)
        w = whitening[spots]
        W[:, each, 0, each, 0] = w[..., 0]
        W[:, each, 0, each, 1] = w[..., 1]
        W[:, each, 1, each, 1] = w[..., 2]
        joint = W.reshape(count, 2 * k, 2 * k)
        C = joint @ cov @ np.swapaxes(joint, 1, 2)
        return cls(spots, 0.5 * (C + np.swapaxes(C, 1, 2)))

    def weighted(self, weights: Array) -> Correlation:
        """Information of each spot (N,) multiplied: as if noise of its own were added.

        A spot of weight zero is correlated with nothing, and the others are as without it.
        """
        root = np.repeat(np.sqrt(weights[self.spots]), 2, axis=1)
        k = self.spots.shape[1]
        own = np.kron(np.eye(k), np.ones((2, 2)))
        share = np.where(own > 0, 1.0, root[:, :, None] * root[:, None, :])
        return Correlation(self.spots, self.matrix * share)


def decorrelated(rows: Array, correlations: tuple[Correlation, ...]) -> Array:
    """Whitened rows (N, 2, m), input order, of which correlated ones are made independent."""
    if not correlations:
        return rows
    out = rows.copy()
    for c in correlations:
        count, k = c.spots.shape
        joint = c.root @ rows[c.spots].reshape(count, 2 * k, -1)
        out[c.spots] = joint.reshape(count, k, 2, -1)
    return out


@dataclass(frozen=True, eq=False)
class Division:
    """A batch in two: spots by themselves, for the fast kernels, and correlated ones."""

    alone: Spots
    shared: Spots
    alone_blocks: Index  # for each block of ``alone`` the batch's it comes from
    shared_blocks: Index
    order: Index  # input index of each shared spot
    correlations: tuple[Correlation, ...]  # spots numbered as in ``order``
    size: int

    @classmethod
    def of(cls, batch: SpotBatch) -> Division:
        """Divide a batch; spots left out are in neither part."""
        together = np.zeros(batch.size, dtype=np.bool_)
        for c in batch.correlations:
            together[c.spots] = True
        mine = together[batch.order]
        alone, alone_blocks = _part(batch.spots, ~mine)
        shared, shared_blocks = _part(batch.spots, mine)
        return cls(
            alone, shared, alone_blocks, shared_blocks,
            batch.order[mine], batch.correlations, batch.size,
        )  # fmt: skip

    def total_loss(self, state: State) -> float:
        """Sum of the squared whitened residuals; inf where a spot cannot be."""
        residuals = kernels.residuals(self.shared, state)
        if not np.isfinite(residuals).all():
            return math.inf
        w00, w01, w11 = self.shared.pixels[2:]
        du, dv = residuals.T
        rows = np.zeros((self.size, 2, 1))
        rows[self.order, :, 0] = np.column_stack([w00 * du + w01 * dv, w11 * dv])
        together = float(np.square(decorrelated(rows, self.correlations)).sum())
        return together + float(kernels.total_loss(self.alone, state, 0, 1.0))

    def information(self, offsets: Index, n: int, state: State) -> Array:
        """Augmented information ``[J r]^T [J r]``, (n+1, n+1); [0, 0] NaN if a spot cannot be.

        ``offsets`` (M, 4): as for `kernels.information`, of the blocks of the batch.
        """
        H: Array = kernels.information(self.alone, offsets[self.alone_blocks], n, state, 0, 1.0)
        if not np.isfinite(kernels.residuals(self.shared, state)).all():
            H[0, 0] = np.nan
            return H
        rows = np.zeros((self.size, 2, n + 1))
        found = kernels.rows(self.shared, state)
        sizes = (6, 9, 4, 3)
        for block, first in zip(self.shared.blocks, offsets[self.shared_blocks], strict=True):
            at = np.concatenate([f + np.arange(s) for f, s in zip(first, sizes, strict=True)])
            members = slice(block[3], block[4])
            rows[self.order[members, None], :, np.append(at, n)] = np.swapaxes(found[members], 1, 2)
        for c in self.correlations:
            count, k = c.spots.shape
            A = (c.root @ rows[c.spots].reshape(count, 2 * k, n + 1)).reshape(-1, n + 1)
            H += A.T @ A
        return H


def _part(spots: Spots, keep: npt.NDArray[np.bool_]) -> tuple[Spots, Index]:
    """Some of the spots, sorted as they were, and the old number of each block that is left."""
    lengths = [int(keep[b[3] : b[4]].sum()) for b in spots.blocks]
    old = np.flatnonzero(lengths)
    ends = np.cumsum([lengths[m] for m in old], dtype=np.int64)
    blocks = spots.blocks[old].copy()
    blocks[:, 4] = ends
    blocks[:, 3] = ends - np.array([lengths[m] for m in old], dtype=np.int64)
    pixels, hands = (np.ascontiguousarray(x[:, keep]) for x in (spots.pixels, spots.hands))
    return Spots(pixels, hands, blocks), old
