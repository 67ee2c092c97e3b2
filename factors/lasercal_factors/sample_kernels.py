"""Compiled loops over small samples of shots: the map that each fixes, and who else agrees.

All shots of a group of non-rotating motions are seen through one homography ``(xy, 1) ~ H (s, 1)``
of the hand's translation across the beam. Four shots fix it; three do where the line that it takes
to infinity is known. Arrays of groups are padded: group ``g`` has ``shots[g]`` entries.

The gain of a map is ``sum max(0, 1 - e^2 / limit^2)`` over the shots of its group, ``e`` the
distance in the image: the number that agree, those near the limit counting less.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

jit = njit(cache=True, nogil=True, error_model="numpy")

# area of the flattest triangle of a sample, as a share of its longest side squared
_FLATTEST = 0.02
# least distance of a shot from the vanishing line, as a share of the farthest shot's
_NEAREST = 0.05


@jit
def _basis(points, sample, out):
    """Columns ``w_i p_i`` with ``sum w_i p_i ~ p_4``; False if three are nearly in one line."""
    x4, y4 = points[sample[3], 0], points[sample[3], 1]
    x1, y1 = points[sample[0], 0] - x4, points[sample[0], 1] - y4
    x2, y2 = points[sample[1], 0] - x4, points[sample[1], 1] - y4
    x3, y3 = points[sample[2], 0] - x4, points[sample[2], 1] - y4
    w1, w2, w3 = x2 * y3 - x3 * y2, x3 * y1 - x1 * y3, x1 * y2 - x2 * y1
    longest = max(x1 * x1 + y1 * y1, x2 * x2 + y2 * y2, x3 * x3 + y3 * y3)
    least = min(min(abs(w1), abs(w2)), min(abs(w3), abs(w1 + w2 + w3)))
    if not least > _FLATTEST * longest:
        return False
    for i in range(3):
        w = w1 if i == 0 else (w2 if i == 1 else w3)
        out[0, i] = w * points[sample[i], 0]
        out[1, i] = w * points[sample[i], 1]
        out[2, i] = w
    return True


@jit
def homography_through(s, xy, sample, H):
    """Homography ``H`` (3, 3) that takes four of the shots ``s`` (n, 2) to their ``xy`` (n, 2).

    False where three of the four are nearly in one line. The scale of ``H`` is any.
    """
    a, b = np.empty((3, 3)), np.empty((3, 3))
    if not (_basis(s, sample, a) and _basis(xy, sample, b)):
        return False
    # H = b a^-1, with the adjugate of a
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        r0 = a[1, j] * a[2, k] - a[2, j] * a[1, k]
        r1 = a[2, j] * a[0, k] - a[0, j] * a[2, k]
        r2 = a[0, j] * a[1, k] - a[1, j] * a[0, k]
        for row in range(3):
            if i == 0:
                H[row, 0] = H[row, 1] = H[row, 2] = 0.0
            H[row, 0] += b[row, i] * r0
            H[row, 1] += b[row, i] * r1
            H[row, 2] += b[row, i] * r2
    return True


@jit
def affine_through(line, across, s, xy, sample, H):
    """Homography with a vanishing line that takes three shots to their pixels; False if flat.

    ``line`` (3,) unit vector, ``across`` (3, 2) an orthonormal basis across it: on the image plane
    ``m / (l'm) = l + N y`` the map is affine, ``y = C (s, 1)``.
    """
    x1, y1 = s[sample[0], 0], s[sample[0], 1]
    x2, y2 = s[sample[1], 0] - x1, s[sample[1], 1] - y1
    x3, y3 = s[sample[2], 0] - x1, s[sample[2], 1] - y1
    area = x2 * y3 - x3 * y2
    longest = max(x2 * x2 + y2 * y2, x3 * x3 + y3 * y3)
    if not abs(area) > _FLATTEST * longest:
        return False
    y = np.empty((3, 2))
    side = 0.0
    for i in range(3):
        u, v = xy[sample[i], 0], xy[sample[i], 1]
        depth = line[0] * u + line[1] * v + line[2]
        if i == 0:
            side = depth
        if not depth * side > 0.0:
            return False
        for j in range(2):
            y[i, j] = (across[0, j] * u + across[1, j] * v + across[2, j]) / depth
    for row in range(3):
        H[row, 0] = H[row, 1] = 0.0
        H[row, 2] = line[row]
    for j in range(2):
        d2, d3 = y[1, j] - y[0, j], y[2, j] - y[0, j]
        c1, c2 = (d2 * y3 - d3 * y2) / area, (d3 * x2 - d2 * x3) / area
        c3 = y[0, j] - c1 * x1 - c2 * y1
        for row in range(3):
            H[row, 0] += across[row, j] * c1
            H[row, 1] += across[row, j] * c2
            H[row, 2] += across[row, j] * c3
    return True


@jit
def gain(H, s, xy, shots, limit2):
    """Gain of one map; 0 if it takes some of the shots behind the camera.

    ``s`` comes from the hand poses, so that the right map has all shots before it, the outliers
    too.
    """
    least, most = math.inf, -math.inf
    for k in range(shots):
        depth = H[2, 0] * s[k, 0] + H[2, 1] * s[k, 1] + H[2, 2]
        least, most = min(least, depth), max(most, depth)
    if not (least > _NEAREST * most and most > 0.0) and not (most < _NEAREST * least):
        return 0.0
    total = 0.0
    for k in range(shots):
        x, y = s[k, 0], s[k, 1]
        depth = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        du = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / depth - xy[k, 0]
        dv = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / depth - xy[k, 1]
        e2 = du * du + dv * dv
        if e2 < limit2:
            total += 1.0 - e2 / limit2
    return total


@jit
def homography_gains(s, xy, shots, samples, counts, limit2):
    """Gains of the homographies that samples of four fix.

    Parameters
    ----------
    s, xy : (G, K, 2)
    shots, counts : (G,) number of shots, and of samples
    samples : (G, M, 4) indices of shots
    limit2 : squared limit of the distance in the image

    Returns
    -------
    (G, M) array
    """
    found = np.zeros(samples.shape[:2])
    H = np.empty((3, 3))
    for g in range(len(shots)):
        for m in range(counts[g]):
            if homography_through(s[g], xy[g], samples[g, m], H):
                found[g, m] = gain(H, s[g], xy[g], shots[g], limit2)
    return found


@jit
def best_affine(line, across, s, xy, shots, samples, counts, limit2):
    """Best map of each group with a given vanishing line, from samples of three.

    Returns
    -------
    gains (G,) and maps (G, 3, 3)
    """
    gains, maps = np.zeros(len(shots)), np.zeros((len(shots), 3, 3))
    H = np.empty((3, 3))
    for g in range(len(shots)):
        for m in range(counts[g]):
            if affine_through(line, across, s[g], xy[g], samples[g, m], H):
                value = gain(H, s[g], xy[g], shots[g], limit2)
                if value > gains[g]:
                    gains[g] = value
                    maps[g] = H
    return gains, maps
