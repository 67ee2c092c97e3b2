"""Compiled steps of a running calibration: stored spots in, information out, some at a time.

A stored spot is one row of 14 numbers (112 bytes): pixel ``u, v``; ``w00, w01, w11`` of the upper
triangle ``W`` with ``W.T @ W = inv(cov_uv)``; the first two columns of the hand's rotation and its
translation (``T_base_hand``, metres). Beside it: the number of its *path* (which camera, laser and
plane it went by) and whether the estimate uses it.

A `View` is a cell in chart coordinates, at one point: whatever is linearised, is linearised there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lasercal_factors.arrays import Array, Index, Spots, State
from lasercal_factors.chart_kernels import move, normal_map, rotation
from lasercal_factors.hand_kernels import by_hand, correct_hands, covariance_of, whitening_of
from lasercal_factors.kernels import cholesky, constrain, information, jit, residuals, rows

RECORD = 14
LEFT_OUT, USED, HELD_BACK = 0, 1, 2


class View(NamedTuple):
    """A cell at one point of its chart.

    state : the cell; M (n, n): a step of the chart's coordinates to the step that `kernels.rows`
    differentiates by; paths (P, 3): camera, laser, plane index of each path; offsets (P, 4): first
    column of camera pose, intrinsics, beam and plane of each path.
    """

    state: State
    M: Array
    paths: Index
    offsets: Index


class Weighing(NamedTuple):
    """What else weighs a spot.

    hand (6,): variances of a hand pose, translation in base (m^2), rotation in hand (rad^2);
    fade: factor on a spot's information for each spot that came after it.
    """

    hand: Array
    fade: float


@jit
def row_map(z, reference, state):
    """(n, n): a step of the chart's coordinates at ``z`` to one of the rows' coordinates there.

    As `chart.CellChart.tangent_map`, and the rows' offset of a plane is GTSAM's, ``-d``.
    """
    M = np.eye(len(z))
    at = 0
    for _ in range(len(reference.cam_R)):
        turn, right = rotation(z[at : at + 3])
        M[at : at + 3, at : at + 3] = right
        M[at + 3 : at + 6, at + 3 : at + 6] = turn.T
        at += 15
    at += 4 * len(reference.beam_l)
    for p in range(len(reference.plane_d)):
        tilt = z[at : at + 2]
        M[at : at + 2, at : at + 2] = normal_map(reference.plane_n[p], state.plane_n[p], tilt)
        M[at + 2, at + 2] = -1.0
        at += 3
    return M


@jit
def view_at(z, aspects, reference, paths, offsets):
    """The `View` at chart coordinates ``z``."""
    state = move(z, aspects, reference)
    return View(state, row_map(z, reference, state), paths, offsets)


@jit
def gather(records, path, view):
    """Spots for the kernels, sorted by path; the row of each; the offsets of each block."""
    count, most = len(records), len(view.paths)
    first = np.zeros(most + 1, np.int64)
    for i in range(count):
        first[path[i] + 1] += 1
    present = 0
    for p in range(most):
        present += 1 if first[p + 1] > 0 else 0
        first[p + 1] += first[p]
    blocks, offsets = np.empty((present, 5), np.int64), np.empty((present, 4), np.int64)
    m = 0
    for p in range(most):
        if first[p + 1] > first[p]:
            blocks[m, :3] = view.paths[p]
            blocks[m, 3], blocks[m, 4] = first[p], first[p + 1]
            offsets[m] = view.offsets[p]
            m += 1
    pixels, hands = np.empty((5, count)), np.empty((12, count))
    order = np.empty(count, np.int64)
    for i in range(count):
        k = first[path[i]]
        first[path[i]] += 1
        order[k] = i
        r = records[i]
        for j in range(5):
            pixels[j, k] = r[j]
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3
            hands[3 * j, k] = r[5 + j]
            hands[3 * j + 1, k] = r[8 + j]
            hands[3 * j + 2, k] = r[5 + a] * r[8 + b] - r[5 + b] * r[8 + a]
            hands[9 + j, k] = r[11 + j]
    return Spots(pixels, hands, blocks), order, offsets


@jit
def squared_lengths(spots, state):
    """Squared whitened residual length of every spot, (N,), and squared pixels; inf where none."""
    r = residuals(spots, state)
    whitened, pixels = np.empty(len(r)), np.empty(len(r))
    for k in range(len(r)):
        du, dv = r[k]
        e0 = spots.pixels[2, k] * du + spots.pixels[3, k] * dv
        e1 = spots.pixels[4, k] * dv
        m = e0 * e0 + e1 * e1
        whitened[k] = m if math.isfinite(m) else np.inf
        pixels[k] = du * du + dv * dv
    return whitened, pixels


@jit
def accumulate(records, path, mark, view, noise, limit, judge, age):
    """Information of some stored spots, linearised at a view.

    Parameters
    ----------
    records (m, 14), path (m,), mark (m,) : as stored
    limit : length in a-priori sigmas beyond which a spot is an outlier
    judge : renew ``mark``, where it is not `HELD_BACK`: `USED` within the limit, else `LEFT_OUT`
    age : how many spots came after the first of these

    Returns
    -------
    H (n+1, n+1) : ``[J r]^T [J r]`` over the used spots in chart coordinates; [0, 0] NaN where a
        used spot cannot be
    sums (4,) : weight of the used spots (their number, if nothing fades); their squared pixel
        residuals, px^2; their squared whitened lengths; weight of the spots left out
    """
    everyone, order, offsets = gather(records, path, view)
    if np.any(noise.hand > 0.0):
        correct_hands(everyone, view.state, noise.hand)
    lengths2, pixels2 = squared_lengths(everyone, view.state)
    blocks, kept = everyone.blocks.copy(), 0
    sums = np.zeros(4)
    for m in range(len(blocks)):
        first = kept
        for k in range(everyone.blocks[m, 3], everyone.blocks[m, 4]):
            i = order[k]
            if mark[i] == HELD_BACK:
                continue
            w = noise.fade ** (age - i) if noise.fade < 1.0 else 1.0
            if judge:
                possible = math.isfinite(lengths2[k])
                mark[i] = USED if possible and lengths2[k] <= limit * limit else LEFT_OUT
            if mark[i] != USED:
                sums[3] += w
                continue
            root = math.sqrt(w)
            for j in range(5):
                everyone.pixels[j, kept] = everyone.pixels[j, k] * (root if j > 1 else 1.0)
            for j in range(12):
                everyone.hands[j, kept] = everyone.hands[j, k]
            sums[0] += w
            sums[1] += w * pixels2[k]
            sums[2] += w * lengths2[k]
            kept += 1
        blocks[m, 3], blocks[m, 4] = first, kept
    used = Spots(everyone.pixels, everyone.hands, blocks)
    H = information(used, offsets, len(view.M), view.state, 0, 1.0)
    return transported(H, view.M), sums


@jit
def transported(H, M):
    """``[J M r]^T [J M r]`` from ``[J r]^T [J r]``; ``M`` is block diagonal."""
    n = len(M)
    out = H.copy()
    if not math.isfinite(H[0, 0]):
        return out
    half = np.zeros((n + 1, n + 1))
    for j in range(n + 1):
        for k in range(max(0, j - 2), min(n, j + 3)):
            m = M[k, j] if j < n else 0.0
            if m != 0.0:
                for i in range(n + 1):
                    half[i, j] += H[i, k] * m
    half[:, n] = H[:, n]
    out[:] = 0.0
    for i in range(n + 1):
        if i == n:
            out[n] = half[n]
            break
        for k in range(max(0, i - 2), min(n, i + 3)):
            if M[k, i] != 0.0:
                for j in range(n + 1):
                    out[i, j] += M[k, i] * half[k, j]
    return out


@jit
def estimate(H, prior, z, held, tie_from, tie_to, tie_ratio):
    """Solve the normal equations of spots and prior.

    Returns ``R`` (n+1, n+1) with ``R.T R`` the constrained sum, and the estimate (n,). The corner
    of ``R`` is the root of the sum of squares that is left there.
    """
    n = len(z)
    total = H + prior
    constrain(total, held, tie_from, tie_to, tie_ratio)
    R = cholesky(total)
    step = np.zeros(n)
    for i in range(n - 1, -1, -1):
        v = R[i, n]
        for j in range(i + 1, n):
            v -= R[i, j] * step[j]
        step[i] = v / R[i, i] if R[i, i] > 0.0 else 0.0
    for t in range(len(tie_from)):
        step[tie_from[t]] = tie_ratio[t] * step[tie_to[t]]
    return R, z - step


@jit
def expect(record, path, view, now, R, weighing, scale, held, tie_from, tie_to, tie_ratio):
    """How one new spot compares with the estimate, before it is used.

    Parameters
    ----------
    record (14,), path : the spot
    view : where ``R`` is linearised; now : the state of the estimate itself
    R, held, ties : as `estimate` has them
    scale : of the a-priori sigmas

    Returns
    -------
    residual (2,) : predicted minus seen, px; NaN where no spot can be
    covariance (2, 2) : of it, by the spot's own noise (pixel and hand) and the estimate's, px^2
    e (2,) : residual, whitened by that covariance
    G (2, 13) : derivatives, whitened alike, by what may move: camera pose 6, beam 4, plane 3 (its
        distance as ``n . x = d``)
    row (2, n+1) : what the spot adds to the square root of the information, by its own noise and at
        the view: derivatives by the chart's coordinates, and the residual
    square : of its pixel residual there, px^2
    """
    n = len(view.M)
    one = np.empty(1, np.int64)
    one[0] = path
    spots, _, offsets = gather(record.reshape(1, -1), one, view)
    r = residuals(spots, now)[0]
    w = spots.pixels[2:, 0]
    if np.any(weighing.hand > 0.0):
        # with the noise of the hand, but at the commanded pose
        _, B = by_hand(spots.hands[:, 0].copy(), spots.blocks[0], now)
        s00, s01, s11 = covariance_of(w[0], w[1], w[2])
        for j in range(6):
            s00 += B[0, j] * weighing.hand[j] * B[0, j]
            s01 += B[0, j] * weighing.hand[j] * B[1, j]
            s11 += B[1, j] * weighing.hand[j] * B[1, j]
        if math.isfinite(s00 * s11 - s01 * s01):
            w[0], w[1], w[2] = whitening_of(s00, s01, s11)
    J = rows(spots, view.state)[0]
    A = np.zeros((2, n))
    start = (0, 6, 15, 19)
    size = (6, 9, 4, 3)
    for b in range(4):
        at = offsets[0, b]
        for i in range(2):
            for j in range(size[b]):
                v = 0.0
                for k in range(max(0, j - 2), min(size[b], j + 3)):
                    v += J[i, start[b] + k] * view.M[at + k, at + j]
                A[i, at + j] = v
    row = np.empty((2, n + 1))
    row[:, :n] = A
    row[:, n] = J[:, 22]
    for t in range(len(tie_from)):
        A[:, tie_to[t]] += tie_ratio[t] * A[:, tie_from[t]]
    # covariance of the residual, whitened by the spot's own noise: I + V V^T, R^T V^T = A^T
    V = np.zeros((2, n))
    for i in range(2):
        for j in range(n):
            if held[j] or R[j, j] <= 0.0:
                continue
            v = A[i, j]
            for k in range(j):
                v -= R[k, j] * V[i, k]
            V[i, j] = v / R[j, j]
    c00 = c11 = 1.0
    c01 = 0.0
    for k in range(n):
        c00 += V[0, k] * V[0, k]
        c01 += V[0, k] * V[1, k]
        c11 += V[1, k] * V[1, k]
    # by its Cholesky factor, times the scale
    l00 = math.sqrt(c00)
    l10 = c01 / l00
    l11 = math.sqrt(max(c11 - l10 * l10, 1e-300))
    b00, b10, b11 = 1.0 / (scale * l00), -l10 / (scale * l00 * l11), 1.0 / (scale * l11)
    e = np.empty(2)
    first, second = w[0] * r[0] + w[1] * r[1], w[2] * r[1]
    e[0], e[1] = b00 * first, b10 * first + b11 * second
    G = np.empty((2, 13))
    for j in range(13):
        k = j if j < 6 else j + 9
        sign = -1.0 if j == 12 else 1.0
        G[0, j] = sign * b00 * J[0, k]
        G[1, j] = sign * (b10 * J[0, k] + b11 * J[1, k])
    # back to pixels: W^-1 C W^-T
    u00, u01, u11 = 1.0 / w[0], -w[1] / (w[0] * w[2]), 1.0 / w[2]
    covariance = np.empty((2, 2))
    covariance[0, 0] = u00 * u00 * c00 + 2.0 * u00 * u01 * c01 + u01 * u01 * c11
    covariance[0, 1] = u11 * (u00 * c01 + u01 * c11)
    covariance[1, 0] = covariance[0, 1]
    covariance[1, 1] = u11 * u11 * c11
    there = u00 * J[0, 22] + u01 * J[1, 22], u11 * J[1, 22]
    square = there[0] * there[0] + there[1] * there[1]
    return r, scale * scale * covariance, e, G, row, square
