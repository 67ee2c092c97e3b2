"""Long streams of spots in the paper's cell, their hand poses all in view.

Some hand poses are planned as for any capture; more come from them by translations, so that a
hundred thousand spots are drawn in a second. Planes and hand rotations come in random order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lasercal_gtsam as lc
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.simulate import PRESETS, MotionDesign, Noise, simulate_cell
from lasercal_gtsam.simulate.motions import spot_in_view
from lasercal_gtsam.simulate.streams import CELL, stream

Names = npt.NDArray[np.str_]

# cells whose calibration needs no distortion terms, or all of them
PRESET_FOR = {"none": "paper", "all": "paper-distorted"}
# hand rotations planned for each plane, and translations from there (metres, a ball)
_ROTATIONS, _REACH = 100, 0.05
_TRIES = 400


class OutOfViewError(Exception):
    """A cell in which the hand poses at hand show no spot on some plane."""


@dataclass(frozen=True)
class Stream:
    """Spots in order, and what they are.

    ``outlier`` (N,): the pixel has nothing to do with the spot. ``uv_true`` (N, 2): without noise.
    """

    truth: lc.Cell
    observations: lc.Observations
    uv_true: Array
    outlier: npt.NDArray[np.bool_]


class Hands:
    """Hand poses on the planes of a cell."""

    def __init__(self, cell: lc.Cell, seed: int) -> None:
        planned = simulate_cell(cell, groups=_ROTATIONS, shots=1, seed=seed).observations
        self.planes = planned.planes
        self.T = {name: planned.T_base_hand[planned.plane == name] for name in self.planes}

    def draw(
        self, cell: lc.Cell, count: int, rng: np.random.Generator, rotations: int = _ROTATIONS
    ) -> tuple[Array, Names]:
        """Poses (count, 4, 4) whose spots are in view in ``cell``, and their planes.

        ``rotations``: how many hand rotations there may be on a plane.
        """
        plane = rng.choice(self.planes, count)
        T = np.empty((count, 4, 4))
        for name in self.planes:
            rows = np.flatnonzero(plane == name)
            for _ in range(_TRIES):
                if not len(rows):
                    break
                T[rows] = self.T[name][rng.integers(rotations, size=len(rows))]
                T[rows, :3, 3] += _in_ball(len(rows), rng)
                rows = rows[~_in_view(cell, name, T[rows])]
            if len(rows):
                raise OutOfViewError(name)
        return T, plane


def make_truth(seed: int, distortion: str = "none") -> lc.Cell:
    """The paper's cell with its random third plane."""
    return PRESETS[PRESET_FOR[distortion]].cell(stream(seed, CELL))


def take(
    cell: lc.Cell,
    T: Array,
    plane: Names,
    noise: Noise,
    rng: np.random.Generator,
    *,
    outliers: float = 0.0,
    first: int = 0,
) -> Stream:
    """See the spots of some poses; a share of them anywhere in the picture instead."""
    size = next(iter(cell.cameras.values())).image_size
    actual = noise.moved_hands(T, rng)
    uv_true = lc.project(cell, actual, plane=plane.tolist())
    if np.isnan(uv_true).any():  # only the robot's noise can do that, and it is small
        raise OutOfViewError("a noisy hand")
    uv = uv_true + noise.pixel_px * rng.standard_normal(uv_true.shape)
    outlier = rng.random(len(uv)) < outliers
    uv[outlier] = rng.uniform(-0.5, np.array(size) - 0.5, (int(outlier.sum()), 2))
    names = plane.tolist()
    seen = lc.Observations.from_arrays(
        uv, T, plane=names, image_size=size, id=range(first, first + len(uv))
    )
    return Stream(cell, seen, uv_true, outlier)


def good_stream(
    seed: int,
    count: int,
    *,
    pixel_px: float = 1.0,
    distortion: str = "none",
    outliers: float = 0.0,
    grouped: int = 40,
) -> Stream:
    """Spots of a cell that stays as it is.

    The first ``grouped`` share two hand rotations on each plane, which the closed form needs.
    """
    truth = make_truth(seed, distortion)
    hands, rng = Hands(truth, seed), np.random.default_rng((seed, 1))
    first, planes = hands.draw(truth, min(grouped, count), rng, rotations=2)
    rest, more = hands.draw(truth, max(count - grouped, 0), rng)
    T, plane = np.concatenate([first, rest]), np.concatenate([planes, more])
    return take(truth, T, plane, Noise(pixel_px=pixel_px), rng, outliers=outliers)


def _in_view(cell: lc.Cell, plane: str, T: Array) -> npt.NDArray[np.bool_]:
    camera, beam = next(iter(cell.cameras.values())), next(iter(cell.lasers.values()))
    return spot_in_view(camera, beam, cell.planes[plane], T[:, :3, :3], T[:, :3, 3], MotionDesign())


def _in_ball(count: int, rng: np.random.Generator) -> Array:
    v = rng.standard_normal((count, 3))
    length = _REACH * rng.random((count, 1)) ** (1 / 3)
    return np.asarray(length * v / np.linalg.norm(v, axis=1, keepdims=True))
