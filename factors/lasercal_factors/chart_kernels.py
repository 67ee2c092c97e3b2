"""Compiled arithmetic of the chart: a whole cell as one vector about a reference state.

Arrays as in `arrays`; the coordinates ``z`` (n,) as in `chart.CellChart`.
"""

from __future__ import annotations

import math

import numpy as np

from lasercal_factors.arrays import State
from lasercal_factors.kernels import (
    cholesky,
    constrain,
    information,
    jit,
    tangent_basis,
    total_loss,
)


@jit
def rotation(w):
    """Rotation matrix of the vector ``w`` and its right Jacobian."""
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 2] = -w[2], w[1], -w[0]
    W[1, 0], W[2, 0], W[2, 1] = w[2], -w[1], w[0]
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    t = math.sqrt(t2)
    if t < 1e-4:
        a, b, c = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        a, b, c = math.sin(t) / t, (1.0 - math.cos(t)) / t2, (t - math.sin(t)) / (t2 * t)
    turn, right = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            square = w[i] * w[j] - one * t2
            turn[i, j] = one + a * W[i, j] + b * square
            right[i, j] = one - b * W[i, j] + c * square
    return turn, right


@jit
def move(z, aspects, reference):
    """State at chart coordinates ``z`` (n,) about a reference state.

    A camera (15): ``R exp(w)``, ``t + R v``, intrinsics added; where ``aspects`` (C,) is a number,
    ``fu`` is that times ``fv``. A beam (4): added. A plane (3): the normal tilted along
    `tangent_basis` and normalised, the distance added.
    """
    cam_R, plane_n = reference.cam_R, reference.plane_n
    R, t, K = cam_R.copy(), reference.cam_t.copy(), reference.cam_K.copy()
    line, normal = reference.beam_l.copy(), plane_n.copy()
    distance = reference.plane_d.copy()
    at = 0
    for c in range(len(cam_R)):
        turn, _ = rotation(z[at : at + 3])
        for i in range(3):
            for j in range(3):
                R[c, i, j] = 0.0
                for k in range(3):
                    R[c, i, j] += cam_R[c, i, k] * turn[k, j]
                t[c, i] += cam_R[c, i, j] * z[at + 3 + j]
        for j in range(9):
            K[c, j] += z[at + 6 + j]
        if not math.isnan(aspects[c]):
            K[c, 0] = aspects[c] * K[c, 1]
        at += 15
    for m in range(len(line)):
        for j in range(4):
            line[m, j] += z[at + j]
        at += 4
    for p in range(len(plane_n)):
        B = tangent_basis(plane_n[p])
        for i in range(3):
            normal[p, i] += B[i, 0] * z[at] + B[i, 1] * z[at + 1]
        normal[p] /= math.sqrt((normal[p] * normal[p]).sum())
        distance[p] += z[at + 2]
        at += 3
    return State(R, t, K, reference.beam_R, reference.beam_t, line, normal, distance)


@jit
def normal_map(n, moved_n, tilt):
    """(2, 2): a step of `move`'s ``tilt`` (2,) to a step along the moved normal's own basis."""
    B, moved_B = tangent_basis(n), tangent_basis(moved_n)
    length = 1.0 / math.sqrt(1.0 + tilt[0] * tilt[0] + tilt[1] * tilt[1])
    M = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            for k in range(3):
                M[i, j] += moved_B[k, i] * B[k, j] * length
    return M


@jit
def _change_columns(H, at, M):
    """Replace columns and rows ``at ...`` of a symmetric ``H`` by their combinations ``M``."""
    k, old = len(M), np.empty(3)
    for r in range(len(H)):
        for i in range(k):
            old[i] = H[r, at + i]
        for j in range(k):
            v = 0.0
            for i in range(k):
                v += old[i] * M[i, j]
            H[r, at + j] = v
    for c in range(len(H)):
        for i in range(k):
            old[i] = H[at + i, c]
        for j in range(k):
            v = 0.0
            for i in range(k):
                v += old[i] * M[i, j]
            H[at + j, c] = v


@jit
def transport(H, z, plane_n, moved_n, cameras, lasers):
    """Turn an information in tangent coordinates at `move`'s result into one in ``z``, in place."""
    at = 0
    for _ in range(cameras):
        turn, right = rotation(z[at : at + 3])
        _change_columns(H, at, right)
        _change_columns(H, at + 3, turn.T)
        at += 15
    at += 4 * lasers
    for p in range(len(plane_n)):
        _change_columns(H, at, normal_map(plane_n[p], moved_n[p], z[at : at + 2]))
        # the rows' offset is GTSAM's, -d
        for i in range(len(H)):
            H[i, at + 2] = -H[i, at + 2]
        for i in range(len(H)):
            H[at + 2, i] = -H[at + 2, i]
        at += 3


@jit
def loss_at(z, aspects, reference, spots, kind, c_loss):
    """`total_loss` at chart coordinates ``z``."""
    return total_loss(spots, move(z, aspects, reference), kind, c_loss)


@jit
def square_root_information_at(z, aspects, reference, spots, offsets, kind, c_loss, constraints):
    """`square_root_information` in chart coordinates, at ``z``."""
    state = move(z, aspects, reference)
    H = information(spots, offsets, len(z), state, kind, c_loss)
    if not math.isfinite(H[0, 0]):
        return H
    transport(H, z, reference.plane_n, state.plane_n, len(state.cam_R), len(state.beam_l))
    held, tie_from, tie_to, tie_ratio = constraints
    constrain(H, held, tie_from, tie_to, tie_ratio)
    return cholesky(H)
