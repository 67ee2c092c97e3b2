"""Compiled loops that watch a stream of innovations for a change.

The statistic is that of Shiryaev (1963) and Roberts (1966), ``R_n = sum_k L_k^n`` over all onsets
``k <= n``, ``L_k^n`` the likelihood ratio of spots k..n under "changed at k" against "unchanged".
Every onset starts with weight one and is multiplied, spot by spot, by ``q(e) / p(e)``: its own
predictive density over that of an unchanged cell. Hence ``R_n - n`` is a martingale while nothing
changes, and the mean number of spots to a false alarm at ``R >= A`` is at least ``A`` (Pollak
1985). That holds for any predictive density ``q`` chosen before the spot is seen: for mixtures of
causes, for a change that is itself estimated on the way, and when two onsets are merged.

Densities as in `change_densities`, rates of outliers as in `change_rates`, arrays as in
`change_arrays`. Arrays keep the onsets along the
last axis, so that loops run several at a time.
"""

from __future__ import annotations

import math

import numpy as np

from lasercal_factors.change_arrays import LAG, SLOTS, WINDOW
from lasercal_factors.change_densities import expected_density, gate_length, outlier_density
from lasercal_factors.change_rates import count_outlier, outlier_rate
from lasercal_factors.kernels import jit

_SINGLE = 15  # onsets up to this age are never merged
_RUN_RATE = 0.9  # rate of outliers of a part that was bumped beyond all prediction
_MIDDLE = 500.0  # spots over which the middle of a plane's spots is remembered


@jit
def _log_add(a, b):
    """``log(exp(a) + exp(b))``."""
    if a < b:
        a, b = b, a
    return a if b == -np.inf else a + math.log1p(math.exp(b - a))


@jit
def _remove(bank, p, m, slot):
    """Forget one onset; younger ones move up."""
    last = bank.used[p, m] - 1
    for k in range(slot, last):
        bank.log_weight[p, m, k] = bank.log_weight[p, m, k + 1]
        bank.first[p, m, k] = bank.first[p, m, k + 1]
        bank.age[p, m, k] = bank.age[p, m, k + 1]
    mean, cov = bank.mean[p, m], bank.cov[p, m]
    for i in range(len(mean)):
        for k in range(slot, last):
            mean[i, k] = mean[i, k + 1]
        for j in range(len(mean)):
            for k in range(slot, last):
                cov[i, j, k] = cov[i, j, k + 1]
    bank.log_weight[p, m, last] = -np.inf
    bank.used[p, m] = last


@jit
def _merge(bank, p, m):
    """Merge two neighbouring onsets into the heavier: the pair whose ages are relatively closest.

    The sum of the weights stays, so that the statistic stays a martingale.
    """
    now, ages = bank.seen[p], bank.age[p, m]
    at, best = 0, np.inf
    for k in range(bank.used[p, m] - _SINGLE - 1):
        ratio = (now - ages[k]) / (now - ages[k + 1])
        if ratio < best:
            at, best = k, ratio
    older, younger = bank.log_weight[p, m, at], bank.log_weight[p, m, at + 1]
    keep, lose = (at, at + 1) if older >= younger else (at + 1, at)
    bank.log_weight[p, m, keep] = _log_add(older, younger)
    _remove(bank, p, m, lose)


@jit
def _open(bank, p, m, number):
    """Add the onset "from this spot on"."""
    if bank.used[p, m] > 0 and bank.seen[p] - bank.age[p, m, 0] >= WINDOW:
        _remove(bank, p, m, 0)
    if bank.used[p, m] == SLOTS:
        _merge(bank, p, m)
    k = bank.used[p, m]
    bank.log_weight[p, m, k] = math.log(bank.share[m])
    bank.first[p, m, k] = number
    bank.age[p, m, k] = bank.seen[p]
    size = bank.prior.shape[2]
    for i in range(size):
        bank.mean[p, m, i, k] = 0.0
        for j in range(size):
            bank.cov[p, m, i, j, k] = bank.prior[p, m, i, j]
    bank.used[p, m] = k + 1


@jit
def _learn(mean, cov, log_weight, used, e, G, common):
    """Multiply every onset by ``q / p`` of this spot and update what it knows of the change.

    ``e = G c + noise`` or an outlier; ``q = good |V|^-1/2 t(e - G mean; V) + bad`` with
    ``V = I + G cov G^T``; ``p = unchanged``. The spot counts in the update as far as it is
    probably no outlier (information scaled by that probability): an approximation of the posterior,
    which costs power at worst, never false alarms. ``common``: good, bad, unchanged, dof. Returns
    the logarithm of the sum of the weights.
    """
    good, bad, unchanged, dof = common
    size = len(mean)
    a, b = np.zeros((size, SLOTS)), np.zeros((size, SLOTS))
    r0, r1 = np.full(SLOTS, e[0]), np.full(SLOTS, e[1])
    s00, s01, s11 = np.zeros(SLOTS), np.zeros(SLOTS), np.zeros(SLOTS)
    for i in range(size):
        for j in range(size):
            g0, g1 = G[0, j], G[1, j]
            for k in range(SLOTS):
                a[i, k] += g0 * cov[i, j, k]
                b[i, k] += g1 * cov[i, j, k]
        g0, g1 = G[0, i], G[1, i]
        for k in range(SLOTS):
            r0[k] -= g0 * mean[i, k]
            r1[k] -= g1 * mean[i, k]
            s00[k] += g0 * a[i, k]
            s01[k] += g0 * b[i, k]
            s11[k] += g1 * b[i, k]
    largest = -np.inf
    for k in range(used):
        # sums of terms that are not negative but for rounding, however large the information
        sound = s00[k] >= 0.0 and s11[k] >= 0.0
        x00, x11 = max(s00[k], 0.0), max(s11[k], 0.0)
        area = max(x00 * x11 - s01[k] * s01[k], 0.0)
        across = x11 * r0[k] * r0[k] + x00 * r1[k] * r1[k] - 2.0 * s01[k] * r0[k] * r1[k]
        det = 1.0 + x00 + x11 + area
        m2 = (r0[k] * r0[k] + r1[k] * r1[k] + max(across, 0.0)) / det
        density = good * expected_density(m2, dof) / math.sqrt(det)
        log_weight[k] += math.log((density + bad) / unchanged)
        largest = max(largest, log_weight[k])
        # gain (I / rho + S)^-1, left in s; none where rounding has used the variance up
        rho = density / (density + bad)
        scale = rho / (1.0 + rho * (x00 + x11 + rho * area)) if sound else 0.0
        s00[k], s11[k] = scale * (1.0 + rho * x11), scale * (1.0 + rho * x00)
        s01[k] *= -scale * rho
    for i in range(size):
        for k in range(used):
            x0 = s00[k] * a[i, k] + s01[k] * b[i, k]
            x1 = s01[k] * a[i, k] + s11[k] * b[i, k]
            mean[i, k] += x0 * r0[k] + x1 * r1[k]
            for j in range(size):
                cov[i, j, k] -= x0 * a[j, k] + x1 * b[j, k]
    total = 0.0
    for k in range(used):
        total += math.exp(log_weight[k] - largest)
    return largest + math.log(total)


@jit
def _look_at_part(bank, p, number, e, G, common):
    """One spot of part ``p``: a new onset, then all of them learn."""
    total = -np.inf
    for m in range(bank.log_weight.shape[1]):
        _open(bank, p, m, number)
        mean, cov, log_weight = bank.mean[p, m], bank.cov[p, m], bank.log_weight[p, m]
        found = _learn(mean, cov, log_weight, bank.used[p, m], e, G, common)
        total = _log_add(total, found)
    bank.log_total[p] = total
    bank.seen[p] += 1


@jit
def _follow(state, share, number, log_ratio):
    """One step of a simple Shiryaev-Roberts statistic ``R = (R + share) ratio`` and its onset.

    The most likely onset is where the cumulative sum of the ratios was last lowest (Page 1954).
    """
    state[0] = _log_add(state[0], math.log(share)) + log_ratio
    if state[1] <= 0.0:
        state[1] = 0.0
        state[2] = number
    state[1] += log_ratio


@jit
def _centre(middle, prior, G):
    """Write a plane's prior (M, 3, 3) for a turn about the middle of its spots.

    A spot moves along the normal by ``c_3 + s . (c_1, c_2)``, where ``s`` is read off the Jacobian;
    independent turn and shift at the mean ``s`` are correlated at the origin.
    """
    length = G[0, 2] * G[0, 2] + G[1, 2] * G[1, 2]
    middle[2] = min(middle[2] + 1.0, _MIDDLE)
    for i in range(2):
        s = (G[0, 2] * G[0, i] + G[1, 2] * G[1, i]) / length
        middle[i] += (s - middle[i]) / middle[2]
    for m in range(len(prior)):
        turn0, turn1 = prior[m, 0, 0], prior[m, 1, 1]
        # the shift's own variance does not change: take out the old correlation, put in the new
        shift = prior[m, 2, 2] - prior[m, 0, 2] ** 2 / turn0 - prior[m, 1, 2] ** 2 / turn1
        prior[m, 0, 2] = prior[m, 2, 0] = -middle[0] * turn0
        prior[m, 1, 2] = prior[m, 2, 1] = -middle[1] * turn1
        prior[m, 2, 2] = shift + middle[0] ** 2 * turn0 + middle[1] ** 2 * turn1


@jit
def _log_sum(totals, start):
    """``start`` and an array of logarithms, summed as `_log_add` does."""
    for value in totals:
        start = _log_add(start, value)
    return start


@jit
def _is_whole(look, n, columns):
    """Shape (n, 2, columns)."""
    return look.shape[0] == n and look.shape[1] == 2 and look.shape[2] == columns


@jit
def _are_possible(looks, parts):
    """Whether shapes fit, indices stay below ``parts`` and numbers are numbers."""
    n = len(looks.e)
    if looks.e.shape[1] != 2 or looks.who.shape[0] != n or looks.who.shape[1] != 3:
        return False
    if len(looks.area) != n or len(looks.dof) != n:
        return False
    if not (_is_whole(looks.by_camera, n, 6) and _is_whole(looks.by_laser, n, 4)):
        return False
    if not _is_whole(looks.by_plane, n, 3):
        return False
    for i in range(n):
        for k in range(3):
            if not 0 <= looks.who[i, k] < parts[k]:
                return False
        if not (looks.area[i] > 0.0 and looks.dof[i] > 0.0):
            return False
        if math.isfinite(looks.e[i, 0]) and math.isfinite(looks.e[i, 1]):
            total = np.sum(looks.by_camera[i]) + np.sum(looks.by_laser[i])
            if not math.isfinite(total + np.sum(looks.by_plane[i])):
                return False
            if looks.by_plane[i, 0, 2] == 0.0 and looks.by_plane[i, 1, 2] == 0.0:
                return False
    return True


@jit
def look(watch, looks, log_threshold, out):
    """Look at spots in order until the first alarm; returns how many were looked at.

    ``out`` (N, 4): logarithm of the statistic, length, limit, probability to be an outlier. Returns
    -1, and looks at nothing, where the input cannot be.
    """
    parts = (len(watch.cameras.seen), len(watch.lasers.seen), len(watch.planes.seen))
    if not _are_possible(looks, parts):
        return -1
    cameras, lasers, planes, recent = watch.cameras, watch.lasers, watch.planes, watch.recent
    for i in range(len(looks.e)):
        e, area, dof = looks.e[i], looks.area[i], looks.dof[i]
        camera, laser, plane = looks.who[i, 0], looks.who[i, 1], looks.who[i, 2]
        number = watch.number[0]
        rate = outlier_rate(
            watch.outliers, cameras.outliers[camera], lasers.outliers[laser], planes.outliers[plane]
        )
        m = e[0] * e[0] + e[1] * e[1]
        if math.isfinite(m):
            good, gross = expected_density(m, dof), outlier_density(m, area)
            unchanged = (1.0 - rate) * good + rate * gross
            run_ratio = math.log(((1.0 - _RUN_RATE) * good + _RUN_RATE * gross) / unchanged)
            probability = rate * gross / unchanged
            # at least the density of outliers of any mixture of the two halves
            bad = 2.0 * rate * gross
            p = (1.0 - rate) * good + bad
            common = (1.0 - rate, bad, p, dof)
            _centre(watch.middle[plane], planes.prior[plane], looks.by_plane[i])
            _look_at_part(cameras, camera, number, e, looks.by_camera[i], common)
            _look_at_part(lasers, laser, number, e, looks.by_laser[i], common)
            _look_at_part(planes, plane, number, e, looks.by_plane[i], common)
            for s in range(len(watch.spread)):
                tau2 = watch.spread_factor[s]
                wide = (1.0 - rate) * expected_density(m / tau2, dof) / tau2 + bad
                _follow(watch.spread[s], watch.spread_share[s], number, math.log(wide / p))
        else:
            run_ratio, probability, m = math.log(_RUN_RATE / rate), 1.0, np.inf
        _follow(cameras.run[camera], cameras.run_share[0], number, run_ratio)
        _follow(lasers.run[laser], lasers.run_share[0], number, run_ratio)
        _follow(planes.run[plane], planes.run_share[0], number, run_ratio)

        row = recent[number % len(recent)]
        row[0], row[1], row[2], row[3] = probability, camera, laser, plane
        count_outlier(watch.outliers, probability)
        if number >= LAG:
            row = recent[(number - LAG) % len(recent)]
            count_outlier(cameras.outliers[int(row[1])], row[0])
            count_outlier(lasers.outliers[int(row[2])], row[0])
            count_outlier(planes.outliers[int(row[3])], row[0])
        watch.number[0] = number + 1

        total = _log_sum(watch.spread[:, 0], -np.inf)
        total = _log_sum(cameras.run[:, 0], _log_sum(cameras.log_total, total))
        total = _log_sum(lasers.run[:, 0], _log_sum(lasers.log_total, total))
        total = _log_sum(planes.run[:, 0], _log_sum(planes.log_total, total))
        out[i, 0], out[i, 1] = total, math.sqrt(m)
        out[i, 2], out[i, 3] = gate_length(rate, area, dof), probability
        if total >= log_threshold:
            return i + 1
    return len(looks.e)
