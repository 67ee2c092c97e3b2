"""The plain arrays that the compiled kernels work on, bundled by name."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


class Spots(NamedTuple):
    """N spots, along the last axis, sorted into M blocks of equal camera, laser and plane.

    pixels (5, N): seen pixel ``u, v`` and ``w00, w01, w11`` of the upper triangle ``W`` with
    ``W.T @ W = inv(cov_uv)``; hands (12, N): ``T_base_hand``, the rotation row by row (9), then the
    translation (3), metres; blocks (M, 5): camera, laser, plane index, first spot, one past the
    last spot.
    """

    pixels: Array
    hands: Array
    blocks: Index


class State(NamedTuple):
    """Values of a cell's variables: C cameras, L lasers, P planes; SI units and pixels.

    cam_R (C, 3, 3), cam_t (C, 3): ``T_base_camera``; cam_K (C, 9): the intrinsics
    ``fu fv skew u0 v0 k1 k2 p1 p2``.
    beam_R (L, 3, 3), beam_t (L, 3), beam_l (L, 4): constant frame and ``a, b, x, y``: the beam runs
    along ``beam_R (a, b, 1)`` through ``beam_t + beam_R (x, y, 0)``, in hand coordinates.
    plane_n (P, 3), plane_d (P,): ``n . x = d``.
    """

    cam_R: Array
    cam_t: Array
    cam_K: Array
    beam_R: Array
    beam_t: Array
    beam_l: Array
    plane_n: Array
    plane_d: Array
