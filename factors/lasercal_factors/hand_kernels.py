"""Compiled correction of hand poses for the robot's noise, spot by spot.

The method is `lasercal_gtsam.hand_noise`'s, which is written to be read: every hand pose is an
unknown with a prior, eliminated in closed form at its most likely correction ``eta``.
"""

from __future__ import annotations

import math

import numpy as np

from lasercal_factors.arrays import Spots
from lasercal_factors.chart_kernels import move, rotation, square_root_information_at
from lasercal_factors.kernels import jit, total_loss

# corrections settle by a factor of 30 to 100 a round
_HAND_ROUNDS = 2
# corrections to the last digit: at most so many rounds, and when they stand still (sigmas)
_MAX_ROUNDS, _SETTLED_SIGMAS = 12, 1e-10


@jit
def by_hand(hand, block, state):
    """Predicted pixel of one hand pose (12,), and its derivative by the pose, (2, 6).

    By the translation in the base, then by the rotation in the hand (method 3.1, chain of 1-9).
    """
    c, l, p = block[0], block[1], block[2]  # noqa: E741
    L, line = state.beam_R[l], state.beam_l[l]
    R, t, K = state.cam_R[c], state.cam_t[c], state.cam_K[c]
    n = state.plane_n[p]
    u, q, b, x = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        u[i] = L[i, 0] * line[0] + L[i, 1] * line[1] + L[i, 2]
        q[i] = state.beam_t[l, i] + L[i, 0] * line[2] + L[i, 1] * line[3]
    for i in range(3):
        b[i] = hand[3 * i] * u[0] + hand[3 * i + 1] * u[1] + hand[3 * i + 2] * u[2]
        x[i] = hand[3 * i] * q[0] + hand[3 * i + 1] * q[1] + hand[3 * i + 2] * q[2] + hand[9 + i]
    nb = n[0] * b[0] + n[1] * b[1] + n[2] * b[2]
    s = (state.plane_d[p] - (n[0] * x[0] + n[1] * x[1] + n[2] * x[2])) / nb
    y = np.empty(3)
    for i in range(3):
        y[i] = 0.0
        for j in range(3):
            y[i] += R[j, i] * (x[j] + s * b[j] - t[j])
    a0, a1 = y[0] / y[2], y[1] / y[2]
    k1, k2, p1, p2 = K[5], K[6], K[7], K[8]
    r2 = a0 * a0 + a1 * a1
    g, dg = 1.0 + r2 * (k1 + k2 * r2), k1 + 2.0 * k2 * r2
    xd = g * a0 + 2.0 * p1 * a0 * a1 + p2 * (r2 + 2.0 * a0 * a0)
    yd = g * a1 + p1 * (r2 + 2.0 * a1 * a1) + 2.0 * p2 * a0 * a1
    uv = np.array([K[0] * xd + K[2] * yd + K[3], K[1] * yd + K[4]])
    d00 = g + 2.0 * a0 * a0 * dg + 2.0 * p1 * a1 + 6.0 * p2 * a0
    d01 = 2.0 * a0 * a1 * dg + 2.0 * p1 * a0 + 2.0 * p2 * a1
    d11 = g + 2.0 * a1 * a1 * dg + 6.0 * p1 * a1 + 2.0 * p2 * a0
    B = np.empty((2, 6))
    for row in range(2):
        if row == 0:
            e0 = (K[0] * d00 + K[2] * d01) / y[2]
            e1 = (K[0] * d01 + K[2] * d11) / y[2]
        else:
            e0, e1 = K[1] * d01 / y[2], K[1] * d11 / y[2]
        e2 = -(e0 * a0 + e1 * a1)
        along = 0.0
        for i in range(3):
            B[row, i] = R[i, 0] * e0 + R[i, 1] * e1 + R[i, 2] * e2
            along += B[row, i] * b[i]
        for i in range(3):
            B[row, i] -= along / nb * n[i]
        # a point s of the hand moves by R_hand (w x s): row . that = (s x (row R_hand)) . w
        h = np.empty(3)
        for j in range(3):
            h[j] = B[row, 0] * hand[j] + B[row, 1] * hand[3 + j] + B[row, 2] * hand[6 + j]
        for j in range(3):
            v, w = (j + 1) % 3, (j + 2) % 3
            B[row, 3 + j] = (q[v] + s * u[v]) * h[w] - (q[w] + s * u[w]) * h[v]
    return uv, B


@jit
def _moved_hand(hand, eta):
    """The hand pose (12,) corrected by ``eta`` (6,): translation in base, rotation in hand."""
    turn, _ = rotation(eta[3:])
    out = np.empty(12)
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = 0.0
            for k in range(3):
                out[3 * i + j] += hand[3 * i + k] * turn[k, j]
        out[9 + i] = hand[9 + i] + eta[i]
    return out


@jit
def covariance_of(w00, w01, w11):
    """Covariance ``(W^T W)^-1`` of a whitening: its upper triangle."""
    v = 1.0 / (w11 * w11)
    return (1.0 + w01 * w01 * v) / (w00 * w00), -w01 * v / w00, v


@jit
def whitening_of(s00, s01, s11):
    """``w00, w01, w11`` of upper triangular ``W`` with ``W^T W`` the inverse of a covariance."""
    det = s00 * s11 - s01 * s01
    w00 = math.sqrt(s11 / det)
    return w00, -s01 / (det * w00), 1.0 / math.sqrt(s11)


@jit
def correct_hands(spots, state, hand):
    """Move every hand pose to where it most likely was, in place; `hand_noise` has the method.

    Residuals become ``r - B eta`` and the whitening that of ``cov_uv + B Sigma B^T``.
    """
    for block in spots.blocks:
        for k in range(block[3], block[4]):
            _correct(spots, k, block, state, hand, _HAND_ROUNDS, 0.0)


@jit
def hands_corrected(spots, state, hand, fixed):
    """A copy of the spots with `correct_hands` done to the last digit, where not ``fixed`` (N,).

    A fixed hand pose stays where it was commanded, its noise still counts.
    """
    moved = Spots(spots.pixels.copy(), spots.hands.copy(), spots.blocks)
    for block in spots.blocks:
        for k in range(block[3], block[4]):
            rounds = 0 if fixed[k] else _MAX_ROUNDS
            _correct(moved, k, block, state, hand, rounds, _SETTLED_SIGMAS)
    return moved


@jit
def _correct(spots, k, block, state, hand, rounds, settled):
    """Correct one hand pose; ends early once no part of ``eta`` moves by ``settled`` sigmas."""
    c00, c01, c11 = covariance_of(spots.pixels[2, k], spots.pixels[3, k], spots.pixels[4, k])
    commanded = spots.hands[:, k].copy()
    eta, moved, at = np.zeros(6), commanded, commanded
    last = (c00, c01, c11, 0.0, 0.0)
    for _ in range(rounds + 1):
        uv, B = by_hand(moved, block, state)
        s00, s01, s11 = c00, c01, c11
        r0, r1 = uv[0] - spots.pixels[0, k], uv[1] - spots.pixels[1, k]
        for j in range(6):
            s00 += B[0, j] * hand[j] * B[0, j]
            s01 += B[0, j] * hand[j] * B[1, j]
            s11 += B[1, j] * hand[j] * B[1, j]
            r0 -= B[0, j] * eta[j]
            r1 -= B[1, j] * eta[j]
        det = s00 * s11 - s01 * s01
        if not (math.isfinite(det) and math.isfinite(r0) and math.isfinite(r1)):
            return
        shift0 = shift1 = 0.0
        for j in range(6):
            shift0 += B[0, j] * eta[j]
            shift1 += B[1, j] * eta[j]
        last = (s00, s01, s11, shift0, shift1)
        at = moved
        g0, g1 = (s11 * r0 - s01 * r1) / det, (s00 * r1 - s01 * r0) / det
        still = True
        before, eta = eta, np.empty(6)
        for j in range(6):
            eta[j] = -hand[j] * (B[0, j] * g0 + B[1, j] * g1)
            still = still and abs(eta[j] - before[j]) <= settled * math.sqrt(hand[j])
        if still:
            break
        moved = _moved_hand(commanded, eta)
    s00, s01, s11, shift0, shift1 = last
    spots.hands[:, k] = at
    spots.pixels[0, k] += shift0
    spots.pixels[1, k] += shift1
    w00, w01, w11 = whitening_of(s00, s01, s11)
    spots.pixels[2, k], spots.pixels[3, k], spots.pixels[4, k] = w00, w01, w11


@jit
def loss_with_hands(z, aspects, reference, spots, hand, fixed):
    """Sum of squared whitened residuals at chart coordinates ``z``, hand poses eliminated there."""
    state = move(z, aspects, reference)
    return total_loss(hands_corrected(spots, state, hand, fixed), state, 0, 1.0)


@jit
def root_with_hands(z, aspects, reference, spots, hand, fixed, offsets, constraints):
    """`chart_kernels.square_root_information_at` with the hand poses eliminated at ``z``.

    The poses are where the error is least, so that its derivative is the one at fixed poses.
    """
    moved = hands_corrected(spots, move(z, aspects, reference), hand, fixed)
    return square_root_information_at(z, aspects, reference, moved, offsets, 0, 1.0, constraints)
