"""Compiled correction of hand poses for the robot's noise, spot by spot.

The method is `lasercal_gtsam.hand_noise`'s, which is written to be read: every hand pose is an
unknown with a prior, eliminated in closed form at its most likely correction ``eta``.
"""

from __future__ import annotations

import math

import numpy as np

from lasercal_factors.arrays import Spots
from lasercal_factors.chart_kernels import move, square_root_information_at
from lasercal_factors.kernels import _path, jit, total_loss

# corrections settle by a factor of 30 to 100 a round
_HAND_ROUNDS = 2
# corrections to many digits: at most so many rounds, and when they stand still (sigmas)
_MAX_ROUNDS, _SETTLED_SIGMAS = 12, 1e-7


@jit
def by_hand(hand, block, state):
    """Predicted pixel of one hand pose (12,), and its derivative by the pose, (2, 6).

    By the translation in the base, then by the rotation in the hand (method 3.1, chain of 1-9).
    """
    B = np.empty((2, 6))
    pixel_u, pixel_v = _by_hand(hand, _path(block, state), B)
    return np.array([pixel_u, pixel_v]), B


@jit
def _by_hand(h, path, B):
    """The same for a path of `kernels._path`: pixel ``u, v``, the derivative into ``B``."""
    u, q, _, n, d, _, R, t, K = path
    b0 = h[0] * u[0] + h[1] * u[1] + h[2] * u[2]
    b1 = h[3] * u[0] + h[4] * u[1] + h[5] * u[2]
    b2 = h[6] * u[0] + h[7] * u[1] + h[8] * u[2]
    x0 = h[0] * q[0] + h[1] * q[1] + h[2] * q[2] + h[9]
    x1 = h[3] * q[0] + h[4] * q[1] + h[5] * q[2] + h[10]
    x2 = h[6] * q[0] + h[7] * q[1] + h[8] * q[2] + h[11]
    inverse = 1.0 / (n[0] * b0 + n[1] * b1 + n[2] * b2)
    s = (d - (n[0] * x0 + n[1] * x1 + n[2] * x2)) * inverse
    # the spot in the camera
    x0, x1, x2 = x0 + s * b0 - t[0], x1 + s * b1 - t[1], x2 + s * b2 - t[2]
    z = 1.0 / (R[0, 2] * x0 + R[1, 2] * x1 + R[2, 2] * x2)
    a0 = (R[0, 0] * x0 + R[1, 0] * x1 + R[2, 0] * x2) * z
    a1 = (R[0, 1] * x0 + R[1, 1] * x1 + R[2, 1] * x2) * z
    k1, k2, p1, p2 = K[5], K[6], K[7], K[8]
    r2 = a0 * a0 + a1 * a1
    g, dg = 1.0 + r2 * (k1 + k2 * r2), k1 + 2.0 * k2 * r2
    xd = g * a0 + 2.0 * p1 * a0 * a1 + p2 * (r2 + 2.0 * a0 * a0)
    yd = g * a1 + p1 * (r2 + 2.0 * a1 * a1) + 2.0 * p2 * a0 * a1
    d00 = g + 2.0 * a0 * a0 * dg + 2.0 * p1 * a1 + 6.0 * p2 * a0
    d01 = 2.0 * a0 * a1 * dg + 2.0 * p1 * a0 + 2.0 * p2 * a1
    d11 = g + 2.0 * a1 * a1 * dg + 6.0 * p1 * a1 + 2.0 * p2 * a0
    # the spot from the hand's origin, in the hand
    c0, c1, c2 = q[0] + s * u[0], q[1] + s * u[1], q[2] + s * u[2]
    for row in range(2):
        if row == 0:
            e0, e1 = (K[0] * d00 + K[2] * d01) * z, (K[0] * d01 + K[2] * d11) * z
        else:
            e0, e1 = K[1] * d01 * z, K[1] * d11 * z
        e2 = -(e0 * a0 + e1 * a1)
        f0 = R[0, 0] * e0 + R[0, 1] * e1 + R[0, 2] * e2
        f1 = R[1, 0] * e0 + R[1, 1] * e1 + R[1, 2] * e2
        f2 = R[2, 0] * e0 + R[2, 1] * e1 + R[2, 2] * e2
        # a spot that the hand moves slides back along the beam onto the plane
        along = (f0 * b0 + f1 * b1 + f2 * b2) * inverse
        f0, f1, f2 = f0 - along * n[0], f1 - along * n[1], f2 - along * n[2]
        B[row, 0], B[row, 1], B[row, 2] = f0, f1, f2
        # a point c of the hand moves by R_hand (w x c): row . that = (c x (row R_hand)) . w
        g0 = f0 * h[0] + f1 * h[3] + f2 * h[6]
        g1 = f0 * h[1] + f1 * h[4] + f2 * h[7]
        g2 = f0 * h[2] + f1 * h[5] + f2 * h[8]
        B[row, 3] = c1 * g2 - c2 * g1
        B[row, 4] = c2 * g0 - c0 * g2
        B[row, 5] = c0 * g1 - c1 * g0
    return K[0] * xd + K[2] * yd + K[3], K[1] * yd + K[4]


@jit
def _move_hand(hand, eta, out):
    """The hand pose (12,) corrected by ``eta`` (6,): translation in base, rotation in hand."""
    w0, w1, w2 = eta[3], eta[4], eta[5]
    t2 = w0 * w0 + w1 * w1 + w2 * w2
    if t2 < 1e-8:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        a, b = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    for i in range(3):
        # row r of a rotation by exp(w): r + a (r x w) + b ((r x w) x w)
        r0, r1, r2 = hand[3 * i], hand[3 * i + 1], hand[3 * i + 2]
        c0, c1, c2 = r1 * w2 - r2 * w1, r2 * w0 - r0 * w2, r0 * w1 - r1 * w0
        out[3 * i] = r0 + a * c0 + b * (c1 * w2 - c2 * w1)
        out[3 * i + 1] = r1 + a * c1 + b * (c2 * w0 - c0 * w2)
        out[3 * i + 2] = r2 + a * c2 + b * (c0 * w1 - c1 * w0)
        out[9 + i] = hand[9 + i] + eta[i]


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
    work = np.empty((2, 12)), np.empty((2, 6)), np.empty((2, 6))
    for block in spots.blocks:
        path = _path(block, state)
        for k in range(block[3], block[4]):
            work[2][0, :] = 0.0
            _correct(spots, k, path, hand, _HAND_ROUNDS, 0.0, work)


@jit
def hands_corrected(spots, state, hand, fixed, eta):
    """A copy of the spots with `correct_hands` done to many digits, where not ``fixed`` (N,).

    A fixed hand pose stays where it was commanded, its noise still counts. ``eta`` (N, 6):
    corrections to begin with, and those found.
    """
    moved = Spots(spots.pixels.copy(), spots.hands.copy(), spots.blocks)
    work = np.empty((2, 12)), np.empty((2, 6)), np.empty((2, 6))
    for block in spots.blocks:
        path = _path(block, state)
        for k in range(block[3], block[4]):
            rounds = 0 if fixed[k] else _MAX_ROUNDS
            for j in range(6):
                work[2][0, j] = eta[k, j]
            _correct(moved, k, path, hand, rounds, _SETTLED_SIGMAS, work)
            for j in range(6):
                eta[k, j] = work[2][0, j]
    return moved


@jit
def _correct(spots, k, path, hand, rounds, settled, work):
    """Correct one hand pose; ends early once no part of ``eta`` moves by ``settled`` sigmas.

    ``work``: two hand poses, a derivative, ``eta`` to begin with and the one before; ``eta`` is
    zero afterwards where no spot can be.
    """
    (commanded, moved), B, (eta, last) = work
    c00, c01, c11 = covariance_of(spots.pixels[2, k], spots.pixels[3, k], spots.pixels[4, k])
    for j in range(12):
        commanded[j] = moved[j] = spots.hands[j, k]
    if rounds == 0:
        eta[:] = 0.0
    elif eta.any():
        _move_hand(commanded, eta, moved)
    for number in range(rounds + 1):
        seen_u, seen_v = _by_hand(moved, path, B)
        s00, s01, s11 = c00, c01, c11
        shift0 = shift1 = 0.0
        for j in range(6):
            s00 += B[0, j] * hand[j] * B[0, j]
            s01 += B[0, j] * hand[j] * B[1, j]
            s11 += B[1, j] * hand[j] * B[1, j]
            shift0 += B[0, j] * eta[j]
            shift1 += B[1, j] * eta[j]
        r0, r1 = seen_u - spots.pixels[0, k] - shift0, seen_v - spots.pixels[1, k] - shift1
        det = s00 * s11 - s01 * s01
        if not (math.isfinite(det) and math.isfinite(r0) and math.isfinite(r1)):
            if number == 0 and eta.any():  # where it began was no good here
                eta[:] = 0.0
                moved[:] = commanded
                continue
            eta[:] = 0.0
            return
        g0, g1 = (s11 * r0 - s01 * r1) / det, (s00 * r1 - s01 * r0) / det
        still = True
        for j in range(6):
            last[j] = eta[j]
            eta[j] = -hand[j] * (B[0, j] * g0 + B[1, j] * g1)
            still = still and abs(eta[j] - last[j]) <= settled * math.sqrt(hand[j])
        if still or number == rounds:
            break
        _move_hand(commanded, eta, moved)
    for j in range(12):
        spots.hands[j, k] = moved[j]
    spots.pixels[0, k] += shift0
    spots.pixels[1, k] += shift1
    w00, w01, w11 = whitening_of(s00, s01, s11)
    spots.pixels[2, k], spots.pixels[3, k], spots.pixels[4, k] = w00, w01, w11


@jit
def loss_with_hands(z, aspects, reference, spots, hand, fixed, eta):
    """Sum of squared whitened residuals at chart coordinates ``z``, hand poses eliminated there."""
    state = move(z, aspects, reference)
    return total_loss(hands_corrected(spots, state, hand, fixed, eta), state, 0, 1.0)


@jit
def root_with_hands(z, aspects, reference, spots, hand, fixed, eta, offsets, constraints):
    """`chart_kernels.square_root_information_at` with the hand poses eliminated at ``z``.

    The poses are where the error is least, so that its derivative is the one at fixed poses.
    """
    moved = hands_corrected(spots, move(z, aspects, reference), hand, fixed, eta)
    return square_root_information_at(z, aspects, reference, moved, offsets, 0, 1.0, constraints)
