"""Compiled loops over many spots: beam -> plane -> camera -> pixel, with derivatives.

Raw float64 arrays in SI units and pixels; no objects. Every function sees the spots sorted into
*blocks*: the spots of one block share camera, laser and plane, so that the 22 unknowns a spot
depends on are the same for the whole block.

Arrays of a batch
-----------------
uv (N, 2), R_base_hand (N, 3, 3), t_base_hand (N, 3)
whitening (N, 3): ``w00, w01, w11`` of the upper triangle ``W`` with ``W.T @ W = inv(cov_uv)``; all
zero for a spot that is left out
blocks (M, 5): camera, laser, plane index, first spot, one past the last spot

Arrays of a state (C cameras, L lasers, P planes)
-------------------------------------------------
cam_R (C, 3, 3), cam_t (C, 3): ``T_base_camera``; cam_K (C, 9): ``fu fv skew u0 v0 k1 k2 p1 p2``
beam_R (L, 3, 3), beam_t (L, 3), beam_l (L, 4): constant frame and ``a, b, x, y``: the beam runs along
``beam_R (a, b, 1)`` through ``beam_t + beam_R (x, y, 0)``, in hand coordinates
plane_n (P, 3), plane_d (P,): ``n . x = d``

Columns of a spot's row: camera pose 6 (rotation first, camera frame, as `gtsam.Pose3`), intrinsics 9,
beam 4, plane 3 (normal 2, then the offset **as GTSAM stores it**, ``-d``), and the residual last.
The residual is predicted minus seen pixel (paper, eq. 55), whitened.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LOSS_NONE, LOSS_HUBER, LOSS_CAUCHY, LOSS_GEMAN_MCCLURE = 0, 1, 2, 3
COLUMNS = 23
# columns padded to an even number, and rows of a panel that stays in the first-level cache
_PADDED, _PANEL = 24, 128

_jit = njit(cache=True, nogil=True, error_model="numpy")


@_jit
def loss_value(kind: int, c: float, m: float) -> float:
    """Robust loss of the squared whitened residual length ``m``; equals ``m`` for small ``m``."""
    if kind == LOSS_HUBER:
        return m if m <= c * c else 2.0 * c * math.sqrt(m) - c * c
    if kind == LOSS_CAUCHY:
        return c * c * math.log1p(m / (c * c))
    if kind == LOSS_GEMAN_MCCLURE:
        return m * c * c / (c * c + m)
    return m


@_jit
def loss_weight(kind: int, c: float, m: float) -> float:
    """Derivative of `loss_value`: the weight of the spot."""
    if kind == LOSS_HUBER:
        return 1.0 if m <= c * c else c / math.sqrt(m)
    if kind == LOSS_CAUCHY:
        return 1.0 / (1.0 + m / (c * c))
    if kind == LOSS_GEMAN_MCCLURE:
        w = c * c / (c * c + m)
        return w * w
    return 1.0


@_jit
def _beam_in_hand(R, t, l):  # type: ignore[no-untyped-def]  # noqa: E741
    """Direction (not normalised) and point of a beam in hand coordinates."""
    u = np.empty(3)
    q = np.empty(3)
    for i in range(3):
        u[i] = R[i, 0] * l[0] + R[i, 1] * l[1] + R[i, 2]
        q[i] = t[i] + R[i, 0] * l[2] + R[i, 1] * l[3]
    return u, q


@_jit
def _residual(k, uv, Rh, th, u, q, n, d, Rc, tc, K):  # type: ignore[no-untyped-def]
    """(ok, du, dv): predicted minus seen pixel (8), (9), (1)-(3); not ok: no spot can be there.

    Not ok means: beam parallel to or away from the plane, spot behind the camera, or beyond the
    radius where the radial distortion turns back on itself.
    """
    b0 = Rh[k, 0, 0] * u[0] + Rh[k, 0, 1] * u[1] + Rh[k, 0, 2] * u[2]
    b1 = Rh[k, 1, 0] * u[0] + Rh[k, 1, 1] * u[1] + Rh[k, 1, 2] * u[2]
    b2 = Rh[k, 2, 0] * u[0] + Rh[k, 2, 1] * u[1] + Rh[k, 2, 2] * u[2]
    x0 = Rh[k, 0, 0] * q[0] + Rh[k, 0, 1] * q[1] + Rh[k, 0, 2] * q[2] + th[k, 0]
    x1 = Rh[k, 1, 0] * q[0] + Rh[k, 1, 1] * q[1] + Rh[k, 1, 2] * q[2] + th[k, 1]
    x2 = Rh[k, 2, 0] * q[0] + Rh[k, 2, 1] * q[1] + Rh[k, 2, 2] * q[2] + th[k, 2]
    s = (d - (n[0] * x0 + n[1] * x1 + n[2] * x2)) / (n[0] * b0 + n[1] * b1 + n[2] * b2)
    x0 += s * b0 - tc[0]
    x1 += s * b1 - tc[1]
    x2 += s * b2 - tc[2]
    z = Rc[0, 2] * x0 + Rc[1, 2] * x1 + Rc[2, 2] * x2
    x = (Rc[0, 0] * x0 + Rc[1, 0] * x1 + Rc[2, 0] * x2) / z
    y = (Rc[0, 1] * x0 + Rc[1, 1] * x1 + Rc[2, 1] * x2) / z
    k1, k2, p1, p2 = K[5], K[6], K[7], K[8]
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + k2 * r2)
    xd = g * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = g * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    ok = s > 0.0 and z > 0.0 and 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2) > 0.0
    return ok, K[0] * xd + K[2] * yd + K[3] - uv[k, 0], K[1] * yd + K[4] - uv[k, 1]


@_jit
def _row(k, uv, W, Rh, th, u, q, Rl, n, B, d, Rc, tc, K, J, r):  # type: ignore[no-untyped-def]
    """Fill columns r, r+1 of ``J`` (23, ...) with the two whitened rows of spot k, by the chain rule.

    False as in `_residual`.
    """
    # beam in base and its hit on the plane (8), (9)
    b0 = Rh[k, 0, 0] * u[0] + Rh[k, 0, 1] * u[1] + Rh[k, 0, 2] * u[2]
    b1 = Rh[k, 1, 0] * u[0] + Rh[k, 1, 1] * u[1] + Rh[k, 1, 2] * u[2]
    b2 = Rh[k, 2, 0] * u[0] + Rh[k, 2, 1] * u[1] + Rh[k, 2, 2] * u[2]
    x0 = Rh[k, 0, 0] * q[0] + Rh[k, 0, 1] * q[1] + Rh[k, 0, 2] * q[2] + th[k, 0]
    x1 = Rh[k, 1, 0] * q[0] + Rh[k, 1, 1] * q[1] + Rh[k, 1, 2] * q[2] + th[k, 1]
    x2 = Rh[k, 2, 0] * q[0] + Rh[k, 2, 1] * q[1] + Rh[k, 2, 2] * q[2] + th[k, 2]
    inu = 1.0 / (n[0] * b0 + n[1] * b1 + n[2] * b2)
    s = (d - (n[0] * x0 + n[1] * x1 + n[2] * x2)) * inu
    x0 += s * b0
    x1 += s * b1
    x2 += s * b2
    # in the camera
    c0, c1, c2 = x0 - tc[0], x1 - tc[1], x2 - tc[2]
    px = Rc[0, 0] * c0 + Rc[1, 0] * c1 + Rc[2, 0] * c2
    py = Rc[0, 1] * c0 + Rc[1, 1] * c1 + Rc[2, 1] * c2
    pz = Rc[0, 2] * c0 + Rc[1, 2] * c1 + Rc[2, 2] * c2
    iz = 1.0 / pz
    x, y = px * iz, py * iz
    fu, fv, sk, k1, k2, p1, p2 = K[0], K[1], K[2], K[5], K[6], K[7], K[8]
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + k2 * r2)
    xd = g * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = g * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    w00, w01, w11 = W[k, 0], W[k, 1], W[k, 2]
    du = fu * xd + sk * yd + K[3] - uv[k, 0]
    dv = fv * yd + K[4] - uv[k, 1]
    J[22, r] = w00 * du + w01 * dv
    J[22, r + 1] = w11 * dv
    # whitened pixel with respect to the distorted coordinates, M = W [[fu, sk], [0, fv]]
    m00, m01, m11 = w00 * fu, w00 * sk + w01 * fv, w11 * fv
    # intrinsics
    J[6, r] = w00 * xd
    J[6, r + 1] = 0.0
    J[7, r] = w01 * yd
    J[7, r + 1] = w11 * yd
    J[8, r] = w00 * yd
    J[8, r + 1] = 0.0
    J[9, r] = w00
    J[9, r + 1] = 0.0
    J[10, r] = w01
    J[10, r + 1] = w11
    J[11, r] = (m00 * x + m01 * y) * r2
    J[11, r + 1] = m11 * y * r2
    J[12, r] = J[11, r] * r2
    J[12, r + 1] = J[11, r + 1] * r2
    a, b = 2.0 * x * y, r2 + 2.0 * y * y
    J[13, r] = m00 * a + m01 * b
    J[13, r + 1] = m11 * b
    b = r2 + 2.0 * x * x
    J[14, r] = m00 * b + m01 * a
    J[14, r + 1] = m11 * a
    # point in the camera: N = M d(xd, yd)/d(x, y), then d(x, y)/dp
    dg = k1 + 2.0 * k2 * r2
    d00 = g + 2.0 * x * x * dg + 2.0 * p1 * y + 6.0 * p2 * x
    d01 = 2.0 * x * y * dg + 2.0 * p1 * x + 2.0 * p2 * y
    d11 = g + 2.0 * y * y * dg + 6.0 * p1 * y + 2.0 * p2 * x
    for i in range(2):
        if i == 0:
            n0, n1 = (m00 * d00 + m01 * d01) * iz, (m00 * d01 + m01 * d11) * iz
        else:
            n0, n1 = m11 * d01 * iz, m11 * d11 * iz
        n2 = -(n0 * x + n1 * y)
        # camera pose: dp = [p]x w - v (right perturbation, as Pose3)
        J[0, r + i] = n1 * pz - n2 * py
        J[1, r + i] = n2 * px - n0 * pz
        J[2, r + i] = n0 * py - n1 * px
        J[3, r + i] = -n0
        J[4, r + i] = -n1
        J[5, r + i] = -n2
        # point in the base
        g0 = Rc[0, 0] * n0 + Rc[0, 1] * n1 + Rc[0, 2] * n2
        g1 = Rc[1, 0] * n0 + Rc[1, 1] * n1 + Rc[1, 2] * n2
        g2 = Rc[2, 0] * n0 + Rc[2, 1] * n1 + Rc[2, 2] * n2
        along = (g0 * b0 + g1 * b1 + g2 * b2) * inu
        # plane: dX = u/nu (-X.dn + dd); GTSAM's offset is -d
        J[19, r + i] = -along * (x0 * B[0, 0] + x1 * B[1, 0] + x2 * B[2, 0])
        J[20, r + i] = -along * (x0 * B[0, 1] + x1 * B[1, 1] + x2 * B[2, 1])
        J[21, r + i] = -along
        # beam: dX = (I - u n^T/nu) R_base_hand (dq + s du)
        g0 -= along * n[0]
        g1 -= along * n[1]
        g2 -= along * n[2]
        h0 = g0 * Rh[k, 0, 0] + g1 * Rh[k, 1, 0] + g2 * Rh[k, 2, 0]
        h1 = g0 * Rh[k, 0, 1] + g1 * Rh[k, 1, 1] + g2 * Rh[k, 2, 1]
        h2 = g0 * Rh[k, 0, 2] + g1 * Rh[k, 1, 2] + g2 * Rh[k, 2, 2]
        J[17, r + i] = h0 * Rl[0, 0] + h1 * Rl[1, 0] + h2 * Rl[2, 0]
        J[18, r + i] = h0 * Rl[0, 1] + h1 * Rl[1, 1] + h2 * Rl[2, 1]
        J[15, r + i] = s * J[17, r + i]
        J[16, r + i] = s * J[18, r + i]
    return s > 0.0 and pz > 0.0 and 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2) > 0.0


@_jit
def tangent_basis(n):  # type: ignore[no-untyped-def]
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
        [n[1] * axis[2] - n[2] * axis[1], n[2] * axis[0] - n[0] * axis[2],
         n[0] * axis[1] - n[1] * axis[0]]
    )  # fmt: skip
    e /= math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    B[:, 0] = e
    B[0, 1] = n[1] * e[2] - n[2] * e[1]
    B[1, 1] = n[2] * e[0] - n[0] * e[2]
    B[2, 1] = n[0] * e[1] - n[1] * e[0]
    return B


@_jit
def residuals(uv, R_base_hand, t_base_hand, blocks, cam_R, cam_t, cam_K, beam_R, beam_t, beam_l,
              plane_n, plane_d):  # type: ignore[no-untyped-def]  # fmt: skip
    """Predicted minus seen pixel of every spot, (N, 2) px; NaN where no spot can be."""
    out = np.empty(uv.shape)
    for m in range(len(blocks)):
        c, l, p = blocks[m, 0], blocks[m, 1], blocks[m, 2]  # noqa: E741
        u, q = _beam_in_hand(beam_R[l], beam_t[l], beam_l[l])
        Rc, tc, K, n, d = cam_R[c], cam_t[c], cam_K[c], plane_n[p], plane_d[p]
        for k in range(blocks[m, 3], blocks[m, 4]):
            ok, du, dv = _residual(k, uv, R_base_hand, t_base_hand, u, q, n, d, Rc, tc, K)
            out[k, 0] = du if ok else np.nan
            out[k, 1] = dv if ok else np.nan
    return out


@_jit
def total_loss(uv, whitening, R_base_hand, t_base_hand, blocks, cam_R, cam_t, cam_K,
               beam_R, beam_t, beam_l, plane_n, plane_d, kind, c_loss):  # type: ignore[no-untyped-def]  # fmt: skip
    """Sum of `loss_value` over all spots; inf where a spot cannot be (so that LM steps back)."""
    total = 0.0
    for m in range(len(blocks)):
        c, l, p = blocks[m, 0], blocks[m, 1], blocks[m, 2]  # noqa: E741
        u, q = _beam_in_hand(beam_R[l], beam_t[l], beam_l[l])
        Rc, tc, K, n, d = cam_R[c], cam_t[c], cam_K[c], plane_n[p], plane_d[p]
        for k in range(blocks[m, 3], blocks[m, 4]):
            if whitening[k, 2] == 0.0:
                continue
            ok, du, dv = _residual(k, uv, R_base_hand, t_base_hand, u, q, n, d, Rc, tc, K)
            if not ok:
                return np.inf
            e0 = whitening[k, 0] * du + whitening[k, 1] * dv
            e1 = whitening[k, 2] * dv
            total += loss_value(kind, c_loss, e0 * e0 + e1 * e1)
    return total if math.isfinite(total) else np.inf


@_jit
def rows(uv, whitening, R_base_hand, t_base_hand, blocks, cam_R, cam_t, cam_K,
         beam_R, beam_t, beam_l, plane_n, plane_d):  # type: ignore[no-untyped-def]  # fmt: skip
    """Whitened Jacobian and residual of every spot, (N, 2, 23); NaN where no spot can be."""
    out = np.full((len(uv), 2, COLUMNS), np.nan)
    J = np.empty((COLUMNS, 2))
    for m in range(len(blocks)):
        c, l, p = blocks[m, 0], blocks[m, 1], blocks[m, 2]  # noqa: E741
        u, q = _beam_in_hand(beam_R[l], beam_t[l], beam_l[l])
        B, Rl = tangent_basis(plane_n[p]), beam_R[l]
        Rc, tc, K, n, d = cam_R[c], cam_t[c], cam_K[c], plane_n[p], plane_d[p]
        for k in range(blocks[m, 3], blocks[m, 4]):
            if _row(k, uv, whitening, R_base_hand, t_base_hand, u, q, Rl, n, B, d, Rc, tc, K, J, 0):
                out[k] = J.T
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})
def _add_products(Q, m, S):  # type: ignore[no-untyped-def]
    """Add ``Q Q^T`` of the first m columns to ``S`` (24, 24), upper 2x2 blocks."""
    for i in range(0, _PADDED, 2):
        for j in range(i, _PADDED, 2):
            s00 = s01 = s10 = s11 = 0.0
            for k in range(m):
                a, b, c, d = Q[i, k], Q[i + 1, k], Q[j, k], Q[j + 1, k]
                s00 += a * c
                s01 += a * d
                s10 += b * c
                s11 += b * d
            S[i, j] += s00
            S[i, j + 1] += s01
            S[i + 1, j] += s10
            S[i + 1, j + 1] += s11


@_jit
def information(uv, whitening, R_base_hand, t_base_hand, blocks, offsets, n_all, cam_R, cam_t,
                cam_K, beam_R, beam_t, beam_l, plane_n, plane_d, kind, c_loss):  # type: ignore[no-untyped-def]  # fmt: skip
    """Augmented information ``[J r]^T [J r]``, (n+1, n+1), upper triangle; [0, 0] NaN if not ok.

    ``offsets`` (M, 4): first global column of camera pose, intrinsics, beam and plane of a block.
    Rows are collected in panels that fit the cache, transposed, and multiplied panel by panel.
    """
    H = np.zeros((n_all + 1, n_all + 1))
    Q = np.zeros((_PADDED, _PANEL))
    S = np.empty((_PADDED, _PADDED))
    column = np.empty(COLUMNS, np.int64)
    for m in range(len(blocks)):
        c, l, p = blocks[m, 0], blocks[m, 1], blocks[m, 2]  # noqa: E741
        u, q = _beam_in_hand(beam_R[l], beam_t[l], beam_l[l])
        B, Rl = tangent_basis(plane_n[p]), beam_R[l]
        Rc, tc, K, n, d = cam_R[c], cam_t[c], cam_K[c], plane_n[p], plane_d[p]
        S[:] = 0.0
        r = 0
        for k in range(blocks[m, 3], blocks[m, 4]):
            if whitening[k, 2] == 0.0:
                continue
            if not _row(
                k, uv, whitening, R_base_hand, t_base_hand, u, q, Rl, n, B, d, Rc, tc, K, Q, r
            ):
                H[0, 0] = np.nan
                return H
            if kind != LOSS_NONE:
                e0, e1 = Q[COLUMNS - 1, r], Q[COLUMNS - 1, r + 1]
                w = math.sqrt(loss_weight(kind, c_loss, e0 * e0 + e1 * e1))
                for i in range(COLUMNS):
                    Q[i, r] *= w
                    Q[i, r + 1] *= w
            r += 2
            if r == _PANEL:
                _add_products(Q, r, S)
                r = 0
        _add_products(Q, r, S)
        for i in range(6):
            column[i] = offsets[m, 0] + i
        for i in range(9):
            column[6 + i] = offsets[m, 1] + i
        for i in range(4):
            column[15 + i] = offsets[m, 2] + i
        for i in range(3):
            column[19 + i] = offsets[m, 3] + i
        column[COLUMNS - 1] = n_all
        for i in range(COLUMNS):
            for j in range(i, COLUMNS):
                a, b = column[i], column[j]
                if a <= b:
                    H[a, b] += S[i, j]
                else:
                    H[b, a] += S[i, j]
    return H


@_jit
def constrain(H, held, tie_from, tie_to, tie_ratio):  # type: ignore[no-untyped-def]
    """Apply ties and held columns to an augmented information in place (upper triangle).

    A tie makes the unknown ``from`` move as ``ratio`` times ``to``: its column is added to that of
    ``to``. Held (and tied) columns are cleared and get a unit pin on the diagonal, so that they do
    not move and the rest is as if they were not there.
    """
    size = len(H)
    for t in range(len(tie_from)):
        f, g, a = tie_from[t], tie_to[t], tie_ratio[t]
        ff = H[f, f]
        fg = H[f, g] if f < g else H[g, f]
        for j in range(size):
            if j != g:
                v = a * (H[f, j] if f <= j else H[j, f])
                if g < j:
                    H[g, j] += v
                else:
                    H[j, g] += v
        H[g, g] += 2.0 * a * fg + a * a * ff
    for i in range(size - 1):
        if held[i]:
            for j in range(size):
                if i <= j:
                    H[i, j] = 0.0
                else:
                    H[j, i] = 0.0
            H[i, i] = 1.0


@_jit
def cholesky(H):  # type: ignore[no-untyped-def]
    """Upper ``R`` with ``R.T @ R = H``, (n+1, n+1); zero rows for null pivots."""
    size = len(H)
    Rt = np.zeros((size, size))
    for i in range(size):
        pivot = H[i, i]
        for k in range(i):
            pivot -= Rt[i, k] * Rt[i, k]
        if not pivot > 1e-15 * H[i, i]:
            continue
        root = math.sqrt(pivot)
        Rt[i, i] = root
        for j in range(i + 1, size):
            v = H[i, j]
            for k in range(i):
                v -= Rt[i, k] * Rt[j, k]
            Rt[j, i] = v / root
    return np.ascontiguousarray(Rt.T)


@_jit
def square_root_information(uv, whitening, R_base_hand, t_base_hand, blocks, offsets, n,
                            cam_R, cam_t, cam_K, beam_R, beam_t, beam_l, plane_n, plane_d,
                            kind, c_loss, held, tie_from, tie_to, tie_ratio):  # type: ignore[no-untyped-def]  # fmt: skip
    """`information`, `constrain` and `cholesky` in one go: ``R`` (n+1, n+1), last column residual.

    [0, 0] is NaN where a spot cannot be.
    """
    H = information(
        uv, whitening, R_base_hand, t_base_hand, blocks, offsets, n, cam_R, cam_t, cam_K,
        beam_R, beam_t, beam_l, plane_n, plane_d, kind, c_loss,
    )  # fmt: skip
    if not math.isfinite(H[0, 0]):
        return H
    constrain(H, held, tie_from, tie_to, tie_ratio)
    return cholesky(H)
