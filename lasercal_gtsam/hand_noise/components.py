"""How large the noise is: variance components by restricted maximum likelihood (REML).

To first order the residuals are ``r = A z + e`` with ``A`` the derivative by the free unknowns and
``e`` of covariance ``V = V_0 + sum_j theta_j V_j``: pixels (``V_j = 1``), translation and rotation
of the hand (``V_j = B_j B_j^T``), each block the spots of one stop. REML is the likelihood of those
combinations of the residuals that no ``z`` can change (Patterson and Thompson 1971),

    -2 L = log |V| + log |A^T V^-1 A + Lambda| + r^T P r,
    P = V^-1 - V^-1 A (A^T V^-1 A + Lambda)^-1 A^T V^-1,

with ``Lambda`` the information of priors. With Fisher's information
``F_jk = tr(P V_j P V_k) / 2`` and the score ``g_j = (r^T P V_j P r - tr(P V_j)) / 2`` scoring goes
to ``theta + F^-1 g``, over ``theta >= 0``; ``F^-1`` is the covariance of the estimate. (Helmert's
and Foerstner's estimators are the same equations.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from lasercal_gtsam.frozen import Array

_MAX_STEPS = 100
_MAX_HALVINGS = 12
# squared length of a scoring step, in standard errors, at which the components stand still
_SETTLED = 1e-10
# smallest change of the likelihood that is more than rounding, relative
_ROUNDING = 1e-12
# smallest variance of the information's correlation matrix that is not rounding
_SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class Block:
    """G stops of k spots each: d = 2k rows and J components.

    Attributes
    ----------
    r : (G, d) px, residuals at the commanded hand poses to first order
    A : (G, d, m) derivative by the free unknowns
    fixed : (G, d, d) px^2, known part of the covariance
    parts : (J, G, d, d) derivative of the covariance by each component
    """

    r: Array
    A: Array
    fixed: Array
    parts: Array


@dataclass(frozen=True, eq=False)
class Components:
    """Variance components found.

    Attributes
    ----------
    theta : (J,) variances, 0 or more
    information : (J, J) Fisher information of ``theta``
    settled : whether the scoring came to a stop
    """

    theta: Array
    information: Array
    settled: bool

    @property
    def standard_errors(self) -> Array:
        """(J,) of ``theta``; infinite where the data cannot tell a component from the others."""
        covariance = _inverse(self.information)
        return np.sqrt(np.diag(covariance))

    @property
    def correlation(self) -> Array:
        """(J, J) correlation of the errors of ``theta``."""
        covariance = _inverse(self.information)
        sigma = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(covariance / np.outer(sigma, sigma))


class Prior(NamedTuple):
    """Priors as rows: ``J`` (p, m) and residuals ``e`` (p,), both in sigmas."""

    J: Array
    e: Array


def variance_components(
    blocks: Sequence[Block], start: Array, prior: Prior | None = None
) -> Components:
    """REML estimate of the components.

    Parameters
    ----------
    blocks : all stops, by their number of spots
    start : (J,) variances to begin with, above 0
    prior : what is known of the unknowns beforehand
    """
    theta = np.array(start, dtype=np.float64)
    state = _State.at(blocks, theta, prior)
    for _ in range(_MAX_STEPS):
        step = state.target(theta) - theta
        length = float(step @ state.information @ step)
        for halving in range(_MAX_HALVINGS):
            tried = theta + 0.5**halving * step
            moved = _State.at(blocks, tried, prior)
            if moved.deviance <= state.deviance + _ROUNDING * abs(state.deviance):
                break
        else:
            return Components(theta, state.information, length < np.sqrt(_SETTLED))
        theta, state = tried, moved
        if length < _SETTLED:
            return Components(theta, state.information, settled=True)
    return Components(theta, state.information, settled=False)


@dataclass(frozen=True, eq=False)
class _State:
    """Likelihood and its derivatives at some components.

    ``deviance`` is ``-2 L``; ``information`` (J, J) Fisher's; ``score`` (J,) the derivative of
    ``L``.
    """

    deviance: float
    information: Array
    score: Array

    @classmethod
    def at(cls, blocks: Sequence[Block], theta: Array, prior: Prior | None) -> _State:
        m, count = blocks[0].A.shape[2], len(theta)
        prior = prior or Prior(np.zeros((0, m)), np.zeros(0))
        N, b, deviance = prior.J.T @ prior.J, prior.J.T @ prior.e, 0.0
        white = []
        for block in blocks:
            V = block.fixed + np.einsum("j,jgab->gab", theta, block.parts)
            L = _cholesky(V)
            if L is None:
                return cls(np.inf, np.eye(count), np.zeros(count))
            A, r = np.linalg.solve(L, block.A), np.linalg.solve(L, block.r[..., None])[..., 0]
            half = np.linalg.solve(L, block.parts)
            parts = np.linalg.solve(L, np.swapaxes(half, -1, -2))  # L^-1 V_j L^-T
            N += np.einsum("gai,gaj->ij", A, A, optimize=True)
            b += np.einsum("gai,ga->i", A, r, optimize=True)
            deviance += 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
            white.append((A, r, parts))
        scale = np.sqrt(np.diag(N))
        root = np.linalg.cholesky(N / np.outer(scale, scale))
        deviance += 2.0 * float(np.log(np.diag(root) * scale).sum())
        z = np.linalg.solve(root.T, np.linalg.solve(root, b / scale)) / scale
        deviance += float(prior.e @ (prior.e - prior.J @ z))
        F, score = np.zeros((count, count)), np.zeros(count)
        inner = np.zeros((count, m, m))  # Q^T V_j Q
        for A, r, parts in white:
            Q = np.linalg.solve(root, (A / scale).reshape(-1, m).T).T.reshape(A.shape)
            residual = r - A @ z
            deviance += float(np.sum(r * residual))
            taken = parts @ Q  # (J, G, d, m)
            F += np.einsum("jgab,kgab->jk", parts, parts, optimize=True)
            F -= 2.0 * np.einsum("jgam,kgam->jk", taken, taken, optimize=True)
            inner += np.einsum("gam,jgan->jmn", Q, taken, optimize=True)
            score += np.einsum("ga,jgab,gb->j", residual, parts, residual, optimize=True)
            score -= np.einsum("jgaa->j", parts)
        F += np.einsum("jmn,kmn->jk", inner, inner)
        score += np.einsum("jmm->j", inner)
        return cls(deviance, 0.5 * F, 0.5 * score)

    def target(self, theta: Array) -> Array:
        """Maximum of the likelihood's quadratic model over ``theta >= 0``."""
        scale = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        F = self.information / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(F)
        values = np.maximum(values, _SINGULAR)
        root = (vectors * np.sqrt(values)).T  # F = root^T root
        wanted = root @ (theta * scale) + (vectors.T @ (self.score / scale)) / np.sqrt(values)
        found, _ = nnls(root, wanted)
        return np.asarray(found / scale)


def _cholesky(V: Array) -> Array | None:
    try:
        return np.asarray(np.linalg.cholesky(V), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _inverse(information: Array) -> Array:
    """Covariance of which directions that are not determined have infinite variance."""
    scale = np.sqrt(np.diag(information))
    with np.errstate(divide="ignore", invalid="ignore"):
        C = np.where(np.outer(scale, scale) > 0, information / np.outer(scale, scale), 0.0)
    values, vectors = np.linalg.eigh(C)
    poor = values < _SINGULAR
    inverse = (vectors / np.where(poor, np.inf, values)) @ vectors.T
    lost = np.abs(vectors[:, poor]).max(axis=1, initial=0.0) > np.sqrt(_SINGULAR)
    inverse[lost, lost] = np.inf
    with np.errstate(divide="ignore"):
        return np.asarray(inverse / np.outer(scale, scale))
