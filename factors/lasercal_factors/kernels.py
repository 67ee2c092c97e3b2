"""Compiled loops over many spots: beam -> plane -> camera -> pixel, with derivatives.

Raw float64 arrays in SI units and pixels; no objects. Every function sees the spots sorted into
*blocks*: the spots of one block share camera, laser and plane, so that the 22 unknowns a spot
depends on are the same for the whole block. Spots are stored along the last axis, so that the loops
run several spots at a time in the processor's vector units.

Arrays are bundled as `arrays.Spots` and `arrays.State`.

Columns of a spot's rows: camera pose 6 (rotation first, camera frame, as `gtsam.Pose3`), intrinsics
9, beam 4, plane 3 (normal 2 along `tangent_basis`, then the offset as GTSAM stores it, ``-d``), and
the residual last: predicted minus seen pixel (paper, eq. 55), whitened.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LOSS_NONE, LOSS_HUBER, LOSS_CAUCHY, LOSS_GEMAN_MCCLURE = 0, 1, 2, 3
COLUMNS = 23
# columns padded to an even number; spots of a panel that stays in the first-level cache
_PADDED, _PANEL = 24, 32

# Infinities and NaN keep their meaning. Sums may be reordered (vector units) and fused only where a
# loop is nothing but a sum: elsewhere the compiler keeps a second version of the loop, for arrays
# that may overlap, and which one runs, with which rounding, would depend on where arrays are in
# memory. Where every operation is rounded by itself, both versions give the same.
_EXACT = {"nsz"}
_FAST = {"reassoc", "contract", "nsz"}
jit = njit(cache=True, nogil=True, error_model="numpy")
_jit_sum = njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
_jit_fill = njit(cache=True, nogil=True, error_model="numpy", fastmath=_EXACT)
_inline = njit(cache=True, nogil=True, error_model="numpy", fastmath=_EXACT, inline="always")


@jit
def loss_value(kind, c, m):
    """Robust loss of the squared whitened residual length ``m``; equals ``m`` for small ``m``."""
    if kind == LOSS_HUBER:
        return m if m <= c * c else 2.0 * c * math.sqrt(m) - c * c
    if kind == LOSS_CAUCHY:
        return c * c * math.log1p(m / (c * c))
    if kind == LOSS_GEMAN_MCCLURE:
        return m * c * c / (c * c + m)
    return m


@jit
def loss_weight(kind, c, m):
    """Derivative of `loss_value`: the weight of the spot."""
    if kind == LOSS_HUBER:
        return 1.0 if m <= c * c else c / math.sqrt(m)
    if kind == LOSS_CAUCHY:
        return 1.0 / (1.0 + m / (c * c))
    if kind == LOSS_GEMAN_MCCLURE:
        w = c * c / (c * c + m)
        return w * w
    return 1.0


@jit
def _beam_in_hand(R, t, l):  # noqa: E741
    """Direction (not normalised) and point of a beam in hand coordinates."""
    u = np.empty(3)
    q = np.empty(3)
    for i in range(3):
        u[i] = R[i, 0] * l[0] + R[i, 1] * l[1] + R[i, 2]
        q[i] = t[i] + R[i, 0] * l[2] + R[i, 1] * l[3]
    return u, q


@jit
def tangent_basis(n):
    """(3, 2) basis across the unit vector ``n``, the same as `gtsam.Unit3.basis`."""
    a0, a1, a2 = abs(n[0]), abs(n[1]), abs(n[2])
    axis = np.zeros(3)
    if a0 <= a1 and a0 <= a2:
        axis[0] = 1.0
    elif a1 <= a0 and a1 <= a2:
        axis[1] = 1.0
    else:
        axis[2] = 1.0
    B = np.empty((3, 2))
    e = np.array(
        [
            n[1] * axis[2] - n[2] * axis[1],
            n[2] * axis[0] - n[0] * axis[2],
            n[0] * axis[1] - n[1] * axis[0],
        ]
    )
    e /= math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    B[:, 0] = e
    B[0, 1] = n[1] * e[2] - n[2] * e[1]
    B[1, 1] = n[2] * e[0] - n[0] * e[2]
    B[2, 1] = n[0] * e[1] - n[1] * e[0]
    return B


@jit
def _path(block, state):
    """What all spots of a block share: beam, plane and camera (see `_fill_panel`)."""
    c, l, p = block[0], block[1], block[2]  # noqa: E741
    u, q = _beam_in_hand(state.beam_R[l], state.beam_t[l], state.beam_l[l])
    n = state.plane_n[p]
    return (
        u, q, state.beam_R[l], n, state.plane_d[p], tangent_basis(n),
        state.cam_R[c], state.cam_t[c], state.cam_K[c],
    )  # fmt: skip


@_inline
def _hit(k, hands, u0, u1, u2, q0, q1, q2, n0, n1, n2, d):
    """Beam in base and its hit on the plane (8), (9): direction, spot, 1/(n.u), length."""
    b0 = hands[0, k] * u0 + hands[1, k] * u1 + hands[2, k] * u2
    b1 = hands[3, k] * u0 + hands[4, k] * u1 + hands[5, k] * u2
    b2 = hands[6, k] * u0 + hands[7, k] * u1 + hands[8, k] * u2
    x0 = hands[0, k] * q0 + hands[1, k] * q1 + hands[2, k] * q2 + hands[9, k]
    x1 = hands[3, k] * q0 + hands[4, k] * q1 + hands[5, k] * q2 + hands[10, k]
    x2 = hands[6, k] * q0 + hands[7, k] * q1 + hands[8, k] * q2 + hands[11, k]
    inu = 1.0 / (n0 * b0 + n1 * b1 + n2 * b2)
    s = (d - (n0 * x0 + n1 * x1 + n2 * x2)) * inu
    return b0, b1, b2, x0 + s * b0, x1 + s * b1, x2 + s * b2, inu, s


@_inline
def _distort(x, y, k1, k2, p1, p2):
    """Distorted coordinates, squared radius and radial factor."""
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + k2 * r2)
    xd = g * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = g * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return xd, yd, r2, g


@_inline
def _impossible(s, z, r2, k1, k2):
    """1.0 where no spot can be, else 0.0.

    Beam parallel to or away from the plane, spot behind the camera, or beyond the radius where the
    radial distortion turns back on itself.
    """
    ok = (s > 0.0) & (z > 0.0) & (1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2) > 0.0)
    return 0.0 if ok else 1.0


@_jit_fill
def _panel_residuals(pixels, hands, base, count, path, out):
    """Fill ``out`` (3, count): predicted minus seen pixel, and 1.0 where impossible."""
    u, q, _, n, d, _, R, t, K = path
    u0, u1, u2, q0, q1, q2, n0, n1, n2 = u[0], u[1], u[2], q[0], q[1], q[2], n[0], n[1], n[2]
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    fu, fv, sk, cu, cv, k1, k2, p1, p2 = K[0], K[1], K[2], K[3], K[4], K[5], K[6], K[7], K[8]
    for i in range(count):
        k = base + i
        _, _, _, x0, x1, x2, _, s = _hit(k, hands, u0, u1, u2, q0, q1, q2, n0, n1, n2, d)
        x0, x1, x2 = x0 - t0, x1 - t1, x2 - t2
        z = r02 * x0 + r12 * x1 + r22 * x2
        iz = 1.0 / z
        x, y = (r00 * x0 + r10 * x1 + r20 * x2) * iz, (r01 * x0 + r11 * x1 + r21 * x2) * iz
        xd, yd, r2, _ = _distort(x, y, k1, k2, p1, p2)
        out[0, i] = fu * xd + sk * yd + cu - pixels[0, k]
        out[1, i] = fv * yd + cv - pixels[1, k]
        out[2, i] = _impossible(s, z, r2, k1, k2)


@_jit_sum
def _panel_loss(pixels, base, count, r, kind, c_loss):
    """(sum of the losses, impossible spots) of a panel's residuals ``r`` (3, count)."""
    total, bad = 0.0, 0.0
    for i in range(count):
        k = base + i
        e0 = pixels[2, k] * r[0, i] + pixels[3, k] * r[1, i]
        e1 = pixels[4, k] * r[1, i]
        m = e0 * e0 + e1 * e1
        total += m if kind == LOSS_NONE else loss_value(kind, c_loss, m)
        bad += r[2, i]
    return total, bad


@_inline
def _fill_panel(pixels, hands, base, count, path, Q):
    """Whitened rows of spots base ... base+count-1 as columns of ``Q`` (24, 2 _PANEL).

    Column i holds the u row of spot base+i, column _PANEL+i its v row; the padding row says 1.0 in
    column i where the spot is impossible. Inlined, so that the compiler sees the constant shape of
    ``Q``.
    """
    u, q, Rl, n, d, B, R, t, K = path
    u0, u1, u2, q0, q1, q2, n0, n1, n2 = u[0], u[1], u[2], q[0], q[1], q[2], n[0], n[1], n[2]
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    fu, fv, sk, cu, cv, k1, k2, p1, p2 = K[0], K[1], K[2], K[3], K[4], K[5], K[6], K[7], K[8]
    l00, l10, l20, l01, l11, l21 = Rl[0, 0], Rl[1, 0], Rl[2, 0], Rl[0, 1], Rl[1, 1], Rl[2, 1]
    B00, B10, B20, B01, B11, B21 = B[0, 0], B[1, 0], B[2, 0], B[0, 1], B[1, 1], B[2, 1]
    for i in range(count):
        k = base + i
        b0, b1, b2, x0, x1, x2, inu, s = _hit(k, hands, u0, u1, u2, q0, q1, q2, n0, n1, n2, d)
        c0, c1, c2 = x0 - t0, x1 - t1, x2 - t2
        px = r00 * c0 + r10 * c1 + r20 * c2
        py = r01 * c0 + r11 * c1 + r21 * c2
        pz = r02 * c0 + r12 * c1 + r22 * c2
        iz = 1.0 / pz
        x, y = px * iz, py * iz
        xd, yd, r2, g = _distort(x, y, k1, k2, p1, p2)
        Q[COLUMNS, i] = _impossible(s, pz, r2, k1, k2)
        w00, w01, w11 = pixels[2, k], pixels[3, k], pixels[4, k]
        du = fu * xd + sk * yd + cu - pixels[0, k]
        dv = fv * yd + cv - pixels[1, k]
        Q[22, i] = w00 * du + w01 * dv
        Q[22, _PANEL + i] = w11 * dv
        # whitened pixel by the distorted coordinates: M = W [[fu, sk], [0, fv]]
        m00, m01, m11 = w00 * fu, w00 * sk + w01 * fv, w11 * fv
        # intrinsics; what is left out of the v row is zero for good
        Q[6, i] = w00 * xd
        Q[7, i] = w01 * yd
        Q[7, _PANEL + i] = w11 * yd
        Q[8, i] = w00 * yd
        Q[9, i] = w00
        Q[10, i] = w01
        Q[10, _PANEL + i] = w11
        a = (m00 * x + m01 * y) * r2
        Q[11, i] = a
        Q[12, i] = a * r2
        a = m11 * y * r2
        Q[11, _PANEL + i] = a
        Q[12, _PANEL + i] = a * r2
        a, b = 2.0 * x * y, r2 + 2.0 * y * y
        Q[13, i] = m00 * a + m01 * b
        Q[13, _PANEL + i] = m11 * b
        b = r2 + 2.0 * x * x
        Q[14, i] = m00 * b + m01 * a
        Q[14, _PANEL + i] = m11 * a
        # distorted by undistorted coordinates (symmetric)
        dg = k1 + 2.0 * k2 * r2
        d00 = g + 2.0 * x * x * dg + 2.0 * p1 * y + 6.0 * p2 * x
        d01 = 2.0 * x * y * dg + 2.0 * p1 * x + 2.0 * p2 * y
        d11 = g + 2.0 * y * y * dg + 6.0 * p1 * y + 2.0 * p2 * x
        for row in range(2):
            j = row * _PANEL + i
            # whitened pixel by the point in the camera
            if row == 0:
                e0, e1 = (m00 * d00 + m01 * d01) * iz, (m00 * d01 + m01 * d11) * iz
            else:
                e0, e1 = m11 * d01 * iz, m11 * d11 * iz
            e2 = -(e0 * x + e1 * y)
            # camera pose: dp = [p]x w - v (right perturbation, as Pose3)
            Q[0, j] = e1 * pz - e2 * py
            Q[1, j] = e2 * px - e0 * pz
            Q[2, j] = e0 * py - e1 * px
            Q[3, j] = -e0
            Q[4, j] = -e1
            Q[5, j] = -e2
            # by the point in the base
            g0 = r00 * e0 + r01 * e1 + r02 * e2
            g1 = r10 * e0 + r11 * e1 + r12 * e2
            g2 = r20 * e0 + r21 * e1 + r22 * e2
            along = (g0 * b0 + g1 * b1 + g2 * b2) * inu
            # plane: dX = u/nu (dd - X.dn); GTSAM's offset is -d
            Q[19, j] = -along * (x0 * B00 + x1 * B10 + x2 * B20)
            Q[20, j] = -along * (x0 * B01 + x1 * B11 + x2 * B21)
            Q[21, j] = -along
            # beam: dX = (I - u n^T/nu) R_base_hand (dq + s du)
            g0, g1, g2 = g0 - along * n0, g1 - along * n1, g2 - along * n2
            h0 = g0 * hands[0, k] + g1 * hands[3, k] + g2 * hands[6, k]
            h1 = g0 * hands[1, k] + g1 * hands[4, k] + g2 * hands[7, k]
            h2 = g0 * hands[2, k] + g1 * hands[5, k] + g2 * hands[8, k]
            f1 = h0 * l00 + h1 * l10 + h2 * l20
            f2 = h0 * l01 + h1 * l11 + h2 * l21
            Q[15, j] = s * f1
            Q[16, j] = s * f2
            Q[17, j] = f1
            Q[18, j] = f2


@_jit_sum
def _add_products(Q, count, S):
    """Add ``Q Q^T`` over the panel's first ``count`` spots to ``S`` (24, 24), upper 2x2 blocks.

    The rest of the panel is cleared: a loop of constant length is what the vector units want.
    """
    for i in range(_PADDED):
        for k in range(count, _PANEL):
            Q[i, k] = 0.0
            Q[i, _PANEL + k] = 0.0
    for i in range(0, _PADDED, 2):
        for j in range(i, _PADDED, 2):
            s00 = s01 = s10 = s11 = 0.0
            for k in range(2 * _PANEL):
                a, b, c, d = Q[i, k], Q[i + 1, k], Q[j, k], Q[j + 1, k]
                s00 += a * c
                s01 += a * d
                s10 += b * c
                s11 += b * d
            S[i, j] += s00
            S[i, j + 1] += s01
            S[i + 1, j] += s10
            S[i + 1, j + 1] += s11


@_jit_fill
def _block_information(pixels, hands, first, last, path, kind, c_loss, S):
    """Add ``[J r]^T [J r]`` of one block to ``S`` (24, 24); returns the impossible spots."""
    Q = np.zeros((_PADDED, 2 * _PANEL))
    for base in range(first, last, _PANEL):
        count = min(_PANEL, last - base)
        _fill_panel(pixels, hands, base, count, path, Q)
        if kind != LOSS_NONE:
            for i in range(count):
                e0, e1 = Q[22, i], Q[22, _PANEL + i]
                w = math.sqrt(loss_weight(kind, c_loss, e0 * e0 + e1 * e1))
                for j in range(COLUMNS):
                    Q[j, i] *= w
                    Q[j, _PANEL + i] *= w
        _add_products(Q, count, S)
    return S[COLUMNS, COLUMNS]


@_jit_fill
def _block_rows(pixels, hands, first, last, path, out):
    """Fill ``out`` (N, 2, 23) with the rows of one block."""
    Q = np.zeros((_PADDED, 2 * _PANEL))
    for base in range(first, last, _PANEL):
        count = min(_PANEL, last - base)
        _fill_panel(pixels, hands, base, count, path, Q)
        for i in range(count):
            for j in range(COLUMNS):
                out[base + i, 0, j] = Q[j, i]
                out[base + i, 1, j] = Q[j, _PANEL + i]


@jit
def _mirrored(state):
    """Number of cameras with a focal length that is not positive: no picture is a mirror image."""
    bad = 0.0
    for K in state.cam_K:
        if not (K[0] > 0.0 and K[1] > 0.0):
            bad += 1.0
    return bad


@jit
def residuals(spots, state):
    """Predicted minus seen pixel of every spot, (N, 2) px; NaN where no spot can be."""
    out = np.empty((spots.pixels.shape[1], 2))
    for block in spots.blocks:
        first, count = block[3], block[4] - block[3]
        r = np.empty((3, count))
        _panel_residuals(spots.pixels, spots.hands, first, count, _path(block, state), r)
        for i in range(count):
            for j in range(2):
                out[first + i, j] = r[j, i] if r[2, i] == 0.0 else np.nan
    return out


@jit
def total_loss(spots, state, kind, c_loss):
    """Sum of `loss_value` over all spots; inf where a spot cannot be (so that LM steps back)."""
    r = np.empty((3, _PANEL))
    total, bad = 0.0, _mirrored(state)
    for block in spots.blocks:
        path = _path(block, state)
        for base in range(block[3], block[4], _PANEL):
            count = min(_PANEL, block[4] - base)
            _panel_residuals(spots.pixels, spots.hands, base, count, path, r)
            panel_total, panel_bad = _panel_loss(spots.pixels, base, count, r, kind, c_loss)
            total += panel_total
            bad += panel_bad
    return total if bad == 0.0 and math.isfinite(total) else np.inf


@jit
def rows(spots, state):
    """Whitened Jacobian and residual of every spot, (N, 2, 23), possible or not."""
    out = np.empty((spots.pixels.shape[1], 2, COLUMNS))
    for block in spots.blocks:
        _block_rows(spots.pixels, spots.hands, block[3], block[4], _path(block, state), out)
    return out


@jit
def information(spots, offsets, n, state, kind, c_loss):
    """Augmented information ``[J r]^T [J r]``, (n+1, n+1); [0, 0] NaN if a spot cannot be.

    ``offsets`` (M, 4): first global column of camera pose, intrinsics, beam and plane of a block.
    """
    H = np.zeros((n + 1, n + 1))
    S = np.empty((_PADDED, _PADDED))
    column = np.empty(COLUMNS, np.int64)
    bad = _mirrored(state)
    for m in range(len(spots.blocks)):
        block = spots.blocks[m]
        S[:] = 0.0
        bad += _block_information(
            spots.pixels, spots.hands, block[3], block[4], _path(block, state), kind, c_loss, S
        )
        for i in range(6):
            column[i] = offsets[m, 0] + i
        for i in range(9):
            column[6 + i] = offsets[m, 1] + i
        for i in range(4):
            column[15 + i] = offsets[m, 2] + i
        for i in range(3):
            column[19 + i] = offsets[m, 3] + i
        column[COLUMNS - 1] = n
        for i in range(COLUMNS):
            for j in range(i, COLUMNS):
                H[column[i], column[j]] += S[i, j]
                if i != j:
                    H[column[j], column[i]] += S[i, j]
    if bad != 0.0:
        H[0, 0] = np.nan
    return H


@jit
def constrain(H, held, tie_from, tie_to, tie_ratio):
    """Apply ties and held columns to an augmented information in place.

    A tie makes the unknown ``from`` move as ``ratio`` times ``to``: its column is added to that of
    ``to``. Held (and tied) columns are cleared and get a unit pin on the diagonal, so that they do
    not move and the rest is as if they were not there.
    """
    for t in range(len(tie_from)):
        for i in range(len(H)):
            H[i, tie_to[t]] += tie_ratio[t] * H[i, tie_from[t]]
        for i in range(len(H)):
            H[tie_to[t], i] += tie_ratio[t] * H[tie_from[t], i]
    for i in range(len(H) - 1):
        if held[i]:
            for j in range(len(H)):
                H[i, j] = 0.0
                H[j, i] = 0.0
            H[i, i] = 1.0


@jit
def cholesky(H):
    """Upper ``R`` with ``R.T @ R = H``, (n+1, n+1); zero rows for null pivots.

    Row by row, so that the inner loop runs along memory.
    """
    size = len(H)
    R = np.zeros((size, size))
    row = np.empty(size)
    for i in range(size):
        for j in range(i, size):
            row[j] = H[i, j]
        for k in range(i):
            factor = R[k, i]
            for j in range(i, size):
                row[j] -= factor * R[k, j]
        if row[i] > 1e-15 * H[i, i]:
            scale = 1.0 / math.sqrt(row[i])
            for j in range(i, size):
                R[i, j] = scale * row[j]
    return R


@jit
def square_root_information(spots, offsets, n, state, kind, c_loss, constraints):
    """`information`, `constrain` and `cholesky` in one go: ``R`` (n+1, n+1), last column residual.

    ``constraints``: the arguments of `constrain`. [0, 0] is NaN where a spot cannot be.
    """
    H = information(spots, offsets, n, state, kind, c_loss)
    if not math.isfinite(H[0, 0]):
        return H
    held, tie_from, tie_to, tie_ratio = constraints
    constrain(H, held, tie_from, tie_to, tie_ratio)
    return cholesky(H)
