"""Contour lines of a function on a grid, as polylines (marching squares)."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from lasercal_gtsam.frozen import Array

# edges of a square: 0 bottom, 1 right, 2 top, 3 left; corners counter-clockwise, lower left first
_CASES: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((3, 0),), 2: ((0, 1),), 3: ((3, 1),), 4: ((1, 2),), 6: ((0, 2),), 7: ((3, 2),),
    8: ((2, 3),), 9: ((2, 0),), 11: ((2, 1),), 12: ((1, 3),), 13: ((1, 0),), 14: ((0, 3),),
}  # fmt: skip
# opposite corners above: joined through the middle if that is above the level, else apart
_SADDLES = {
    (5, True): ((3, 2), (1, 0)),
    (5, False): ((3, 0), (1, 2)),
    (10, True): ((0, 3), (2, 1)),
    (10, False): ((0, 1), (2, 3)),
}

_Node = tuple[int, int, bool]


def contour_lines(x: Array, y: Array, z: Array, level: float) -> list[Array]:
    """Where a function given on a grid takes a value, by linear interpolation along the grid.

    Parameters
    ----------
    x, y : (nx,) and (ny,) places of the nodes, increasing
    z : (ny, nx) values; NaN where there are none, and no line passes such squares
    level : the value

    Returns
    -------
    list of (K, 2) arrays
        Polylines; a closed one ends where it begins.
    """
    links: dict[_Node, list[_Node]] = defaultdict(list)
    above = z >= level
    corners = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, 1:], z[1:, :-1]])
    kinds = (
        above[:-1, :-1] * 1 + above[:-1, 1:] * 2 + above[1:, 1:] * 4 + above[1:, :-1] * 8
    ).astype(int)
    kinds[~np.isfinite(corners).all(axis=0)] = 0
    middle = corners.mean(axis=0) >= level
    for j, i in np.argwhere((kinds > 0) & (kinds < 15)):
        kind = int(kinds[j, i])
        pairs = _CASES.get(kind) or _SADDLES[kind, bool(middle[j, i])]
        # a node is an edge of the grid by its lower left end, and whether it is upright
        edges = ((j, i, False), (j, i + 1, True), (j + 1, i, False), (j, i, True))
        for a, b in pairs:
            first, last = _node(edges[a]), _node(edges[b])
            links[first].append(last)
            links[last].append(first)
    return [np.array([_place(x, y, z, level, n) for n in line]) for line in _joined(links)]


def _node(edge: tuple[int, int, bool]) -> _Node:
    return int(edge[0]), int(edge[1]), edge[2]


def _place(x: Array, y: Array, z: Array, level: float, node: _Node) -> tuple[float, float]:
    j, i, upright = node
    a, b = z[j, i], z[j + 1, i] if upright else z[j, i + 1]
    s = (level - a) / (b - a)
    if upright:
        return float(x[i]), float(y[j] + s * (y[j + 1] - y[j]))
    return float(x[i] + s * (x[i + 1] - x[i])), float(y[j])


def _joined(links: dict[_Node, list[_Node]]) -> list[list[_Node]]:
    """Chains of linked nodes: those with ends first, then the closed ones."""
    lines = []
    for start in sorted(links, key=lambda node: (len(links[node]), node)):
        while links[start]:
            line = [start]
            while links[line[-1]]:
                here = line[-1]
                there = links[here].pop()
                links[there].remove(here)
                line.append(there)
            lines.append(line)
    return lines


def even_levels(low: float, high: float, count: int) -> Array:
    """About ``count`` multiples of a round step between ``low`` and ``high`` (exclusive)."""
    if not 0 <= low < high < np.inf:
        return np.zeros(0)
    step = round_up((high - low) / count)
    digits = max(0, -int(np.floor(np.log10(step))))
    row = step * np.arange(np.floor(low / step), np.ceil(high / step) + 1)
    return np.asarray(row[(row > low) & (row < high)].round(digits))


def row_of_levels(low: float, high: float) -> Array:
    """Powers of ten times 1, 2 and 5 between ``low`` > 0 and ``high`` (exclusive)."""
    if not 0 < low < high < np.inf:
        return np.zeros(0)
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    row = np.array([float(f"{m}e{e}") for e in powers for m in (1, 2, 5)])
    return np.asarray(row[(row > low) & (row < high)])


def round_up(value: float) -> float:
    """Smallest 1, 2 or 5 times a power of ten that is at least ``value`` (> 0)."""
    power = int(np.floor(np.log10(value)))
    row = (float(f"{m}e{power}") for m in (1, 2, 5, 10))
    return next(number for number in row if number >= value * (1 - 1e-12))
