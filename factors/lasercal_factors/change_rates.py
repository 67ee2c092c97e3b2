"""The running rate of gross outliers: overall, and of each part of the cell; compiled."""

from __future__ import annotations

import math

from lasercal_factors.kernels import jit

_CLEAN, _DIRTY = (0.5, 1500.0), (1.0, 9.0)  # Beta priors of the rate of outliers
_DOUBT, _PART_DOUBT = 0.1, 0.01  # prior probabilities that all spots, or those of a part, are dirty
_PART_SPOTS = 300.0  # weight, in spots, with which a part's own rate leans on the overall one
_MEMORY = 10_000.0  # spots over which rates are remembered


@jit
def _log_beta(a, b):
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@jit
def _rate(counts, a, b, doubt):
    """Posterior mean of a rate of outliers from ``counts`` (2,), prior a mixture of two.

    Beta(a, b), and with probability ``doubt`` the wide Beta of `_DIRTY`: a stream is either clean
    or it is not, and a few hundred spots tell.
    """
    x, good = counts[0], max(counts[1] - counts[0], 0.0)
    c, d = _DIRTY
    usual = _log_beta(a + x, b + good) - _log_beta(a, b)
    dirty = _log_beta(c + x, d + good) - _log_beta(c, d) + math.log(doubt / (1.0 - doubt))
    weight = 1.0 / (1.0 + math.exp(min(usual - dirty, 700.0)))
    return (1.0 - weight) * (a + x) / (a + b + x + good) + weight * (c + x) / (c + d + x + good)


@jit
def overall_rate(counts):
    """Posterior mean of the rate of outliers, from ``counts`` (2,)."""
    return _rate(counts, *_CLEAN, _DOUBT)


@jit
def outlier_rate(overall, camera, laser, plane):
    """Running rate of outliers: the largest of the overall one and those of the three parts.

    From counts (2,). Parts are expected to be about as all together. The largest, because a rate
    too low makes alarms and a rate too high only delays them.
    """
    whole = overall_rate(overall)
    rate = whole
    for counts in (camera, laser, plane):
        a, b = _PART_SPOTS * whole, _PART_SPOTS * (1.0 - whole)
        rate = max(rate, _rate(counts, a, b, _PART_DOUBT))
    return min(rate, 0.5)


@jit
def count_outlier(counts, probability):
    """Count a spot, fading the past beyond `_MEMORY` spots."""
    counts[0] += probability
    counts[1] += 1.0
    if counts[1] > _MEMORY:
        counts[0] *= _MEMORY / counts[1]
        counts[1] = _MEMORY
