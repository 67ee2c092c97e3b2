"""Factors for laser spots: one spot at a time, or all spots of a cell in one factor.

Both say the same: predicted minus seen pixel (paper, eq. 55) of the chain beam -> plane -> camera.
`LaserSpotFactor` is the textbook custom factor for a graph of your own. `LaserSpotBatchFactor`
holds any number of spots; it hands GTSAM the square root of their information, not their rows, so
that GTSAM's part of a linearisation does not depend on the number of spots.

Variables
---------
camera pose `gtsam.Pose3` (``T_base_camera``), intrinsics `gtsam.Cal3DS2`, beam 4-vector about a
`BeamFrame` (hand coordinates), plane `gtsam.OrientedPlane3` (base; GTSAM's ``n.x + d = 0``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt

from lasercal_factors import kernels
from lasercal_factors.beam import BeamFrame
from lasercal_factors.errors import FactorError
from lasercal_factors.wrap import custom_factor

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
LossName = Literal["none", "huber", "cauchy", "geman-mcclure"]
_IMPOSSIBLE = (
    "linearised where a beam misses its plane, a spot lies behind its camera, or the distortion "
    "folds; check the start value"
)
LOSSES: dict[str, int] = {"none": 0, "huber": 1, "cauchy": 2, "geman-mcclure": 3}


@dataclass(frozen=True)
class Loss:
    """Robust loss on the whitened length of a spot's residual; ``threshold`` in sigmas."""

    name: LossName = "none"
    threshold: float = 1.0

    def __post_init__(self) -> None:
        if self.name not in LOSSES or not self.threshold > 0:
            raise FactorError(f"loss: one of {', '.join(LOSSES)}, threshold > 0; got {self}")


class State(NamedTuple):
    """Values of a cell's variables as plain arrays (see `kernels`)."""

    cam_R: Array
    cam_t: Array
    cam_K: Array
    beam_R: Array
    beam_t: Array
    beam_l: Array
    plane_n: Array
    plane_d: Array


@dataclass(frozen=True)
class CellKeys:
    """Keys of a cell's variables, in the column order of the batch factor.

    ``cameras`` holds (pose key, intrinsics key) pairs; ``frames`` one `BeamFrame` for each laser;
    ``aspects`` an optional fixed ``fu / fv`` for each camera (then ``fu`` follows ``fv``).
    """

    cameras: tuple[tuple[int, int], ...]
    lasers: tuple[int, ...]
    planes: tuple[int, ...]
    frames: tuple[BeamFrame, ...]
    aspects: tuple[float | None, ...] = ()

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.lasers):
            raise FactorError(f"{len(self.lasers)} lasers but {len(self.frames)} beam frames")
        if not self.aspects:
            object.__setattr__(self, "aspects", (None,) * len(self.cameras))

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """All keys: every camera's pose and intrinsics, then lasers, then planes."""
        return (*(k for pair in self.cameras for k in pair), *self.lasers, *self.planes)

    @cached_property
    def dims(self) -> tuple[int, ...]:
        """Tangent dimension of each key."""
        return (*(6, 9) * len(self.cameras), *(4,) * len(self.lasers), *(3,) * len(self.planes))

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each key."""
        ends = np.cumsum(self.dims)
        return tuple(slice(int(e) - d, int(e)) for e, d in zip(ends, self.dims, strict=True))

    @cached_property
    def n(self) -> int:
        """Number of columns."""
        return sum(self.dims)

    @cached_property
    def _frame_arrays(self) -> tuple[Array, Array]:
        return np.array([f.R for f in self.frames]), np.array([f.t for f in self.frames])

    def read(self, values: gtsam.Values) -> State:
        """Arrays of the variables in ``values``."""
        n_cameras, n_planes = len(self.cameras), len(self.planes)
        cam_R, cam_t = np.empty((n_cameras, 3, 3)), np.empty((n_cameras, 3))
        cam_K = np.empty((n_cameras, 9))
        for c, (x, k) in enumerate(self.cameras):
            pose = values.atPose3(x)
            cam_R[c] = pose.rotation().matrix()
            cam_t[c] = pose.translation()
            cam_K[c] = values.atCal3DS2(k).vector()
            aspect = self.aspects[c]
            if aspect is not None:
                cam_K[c, 0] = aspect * cam_K[c, 1]
        beam_l = np.empty((len(self.lasers), 4))
        for i, key in enumerate(self.lasers):
            beam_l[i] = values.atVector(key)
        planes = np.empty((n_planes, 4))
        for i, key in enumerate(self.planes):
            planes[i] = values.atOrientedPlane3(key).planeCoefficients()
        plane_n = planes[:, :3].copy()
        return State(cam_R, cam_t, cam_K, *self._frame_arrays, beam_l, plane_n, -planes[:, 3])


@dataclass(frozen=True, eq=False)
class SpotBatch:
    """Spots sorted into blocks of equal camera, laser and plane; build it with `from_arrays`.

    Attributes
    ----------
    pixels, hands, blocks : see `kernels`; spots along the last axis
    order : (N,) input index of each spot held
    size : number of spots given (some may have been left out by `weighted`)
    """

    pixels: Array
    hands: Array
    blocks: Index
    order: Index
    size: int

    @classmethod
    def from_arrays(
        cls,
        uv: npt.ArrayLike,
        cov_uv: npt.ArrayLike,
        T_base_hand: npt.ArrayLike,
        camera: npt.ArrayLike,
        laser: npt.ArrayLike,
        plane: npt.ArrayLike,
    ) -> SpotBatch:
        """Sort and whiten.

        Parameters
        ----------
        uv : (N, 2) px
        cov_uv : (N, 2, 2) px^2, positive definite
        T_base_hand : (N, 4, 4), metres
        camera, laser, plane : (N,) indices into the keys of `CellKeys`

        Raises
        ------
        FactorError
            On shapes that do not fit, no spots, or a covariance that is not positive definite.
        """
        uv, T = np.asarray(uv, dtype=np.float64), np.asarray(T_base_hand, dtype=np.float64)
        count = len(uv)
        who = np.column_stack([np.asarray(x, dtype=np.int64) for x in (camera, laser, plane)])
        if not count or uv.shape != (count, 2) or T.shape != (count, 4, 4) or len(who) != count:
            raise FactorError(
                f"spots: uv {uv.shape}, T_base_hand {T.shape}, {len(who)} indices; expected "
                "(N, 2), (N, 4, 4) and N with N > 0"
            )
        order = np.lexsort((who[:, 2], who[:, 1], who[:, 0]))
        whitening = whitening_from_covariance(np.asarray(cov_uv, dtype=np.float64))
        pixels = np.concatenate([uv, whitening], axis=1)[order].T
        hands = np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]], axis=1)[order].T
        return cls(
            np.ascontiguousarray(pixels),
            np.ascontiguousarray(hands),
            _blocks(who[order]),
            order,
            count,
        )

    def __len__(self) -> int:
        return self.size

    def weighted(self, weights: npt.ArrayLike) -> SpotBatch:
        """Multiply the information of each spot by a weight (N,), input order.

        Spots of weight zero are left out altogether, even if no spot can be where they are.
        """
        given = np.asarray(weights, dtype=np.float64)
        if given.shape != (self.size,) or not np.all(given >= 0):
            raise FactorError(f"weights: expected ({self.size},) numbers >= 0, got {given.shape}")
        weight = given[self.order]
        keep = weight > 0
        if not keep.any():
            raise FactorError("weights: every spot has weight zero")
        who = np.repeat(self.blocks[:, :3], self.blocks[:, 4] - self.blocks[:, 3], axis=0)
        pixels = self.pixels[:, keep].copy()
        pixels[2:] *= np.sqrt(weight[keep])
        hands = np.ascontiguousarray(self.hands[:, keep])
        return SpotBatch(pixels, hands, _blocks(who[keep]), self.order[keep], self.size)

    def scaled(self, scale: float) -> SpotBatch:
        """The same spots with every pixel sigma multiplied by ``scale``."""
        pixels = self.pixels.copy()
        pixels[2:] /= scale
        return SpotBatch(pixels, self.hands, self.blocks, self.order, self.size)

    @cached_property
    def used(self) -> npt.NDArray[np.bool_]:
        """(N,) booleans in input order: spots that are not left out."""
        out = np.zeros(self.size, dtype=np.bool_)
        out[self.order] = True
        return out

    def residuals(self, state: State) -> Array:
        """Predicted minus seen pixel in input order, (N, 2); NaN where impossible or left out."""
        out = np.full((self.size, 2), np.nan)
        out[self.order] = kernels.residuals(self.pixels, self.hands, self.blocks, *state)
        return out

    def whitened_lengths(self, state: State) -> Array:
        """Length of each whitened residual (sigmas), input order, (N,); NaN as in `residuals`."""
        du, dv = kernels.residuals(self.pixels, self.hands, self.blocks, *state).T
        w00, w01, w11 = self.pixels[2:]
        out = np.full(self.size, np.nan)
        out[self.order] = np.hypot(w00 * du + w01 * dv, w11 * dv)
        return out

    def rows(self, state: State) -> Array:
        """Whitened Jacobian and residual of each spot in input order, (N, 2, 23)."""
        out = np.full((self.size, 2, kernels.COLUMNS), np.nan)
        out[self.order] = kernels.rows(self.pixels, self.hands, self.blocks, *state)
        return out

    def total_loss(self, state: State, loss: Loss) -> float:
        """Sum of the losses (twice the graph's error); inf where a spot cannot be."""
        return float(
            kernels.total_loss(
                self.pixels, self.hands, self.blocks, *state, LOSSES[loss.name], loss.threshold
            )
        )


def _blocks(who: Index) -> Index:
    """Blocks of equal rows of ``who`` (N, 3), which is sorted."""
    first = np.flatnonzero(np.append(True, np.any(who[1:] != who[:-1], axis=1)))
    return np.column_stack([who[first], first, np.append(first[1:], len(who))])


def LaserSpotFactor(
    camera_key: int,
    intrinsics_key: int,
    laser_key: int,
    plane_key: int,
    uv: npt.ArrayLike,
    T_base_hand: npt.ArrayLike,
    frame: BeamFrame,
    cov_uv: npt.ArrayLike,
) -> gtsam.CustomFactor:
    """One laser spot as a factor on camera pose, intrinsics, beam and plane (eq. 1-9, 55).

    Parameters
    ----------
    camera_key, intrinsics_key, laser_key, plane_key : keys of a `Pose3`, a `Cal3DS2`, a 4-vector
        (see ``frame``) and an `OrientedPlane3`
    uv : (2,) seen pixel
    T_base_hand : (4, 4) hand pose, metres
    frame : constant `BeamFrame` about which the 4-vector is meant
    cov_uv : (2, 2) px^2

    Returns
    -------
    gtsam.CustomFactor
        Error: whitened predicted minus seen pixel, (2,). Infinite where the beam misses the plane
        or the spot lies behind the camera.

    Raises
    ------
    FactorError
        Wrong shapes; or, from inside a solver, linearised at a state where no spot can be.
    """
    keys = CellKeys(((camera_key, intrinsics_key),), (laser_key,), (plane_key,), (frame,))
    batch = SpotBatch.from_arrays(
        np.asarray(uv)[None], np.asarray(cov_uv)[None], np.asarray(T_base_hand)[None], [0], [0], [0]
    )
    w00, w01, w11 = batch.pixels[2:, 0]

    def error(values: Any) -> Array:
        du, dv = batch.residuals(keys.read(values))[0]
        if math.isnan(du):
            return np.full(2, np.inf)
        return np.array([w00 * du + w01 * dv, w11 * dv])

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        state = keys.read(values)
        if math.isnan(batch.residuals(state)[0, 0]):
            raise FactorError("LaserSpotFactor: " + _IMPOSSIBLE)
        row = batch.rows(state)[0]
        return row[:, 22], [row[:, c] for c in keys.columns]

    noise = gtsam.noiseModel.Unit.Create(2)
    return custom_factor("LaserSpotFactor", noise, keys.keys, keys.dims, error, linearize)


def LaserSpotBatchFactor(
    keys: CellKeys,
    batch: SpotBatch,
    loss: Loss | None = None,
    held: npt.ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """All spots of a cell as one factor by square-root information.

    Same error, gradient and Gauss-Newton Hessian as one `LaserSpotFactor` for each spot. The
    Jacobian is the Cholesky factor of ``[J r]^T [J r]``, n+1 rows whatever the number of spots.

    Parameters
    ----------
    keys : the variables; the batch's indices refer to them
    batch : the spots
    loss : robust loss for each spot (its derivative weights the spot)
    held : (n,) booleans: tangent coordinates that must not move. They get a unit pin, so that the
        rest is solved, and its covariance is, as if they were constants; their own marginal
        covariance is then 1 and without meaning.

    Raises
    ------
    FactorError
        An index without a key; or, from inside a solver, linearised where no spot can be.
    """
    loss = loss or Loss()
    limits = (len(keys.cameras), len(keys.lasers), len(keys.planes))
    if np.any(batch.blocks[:, :3].max(axis=0) >= limits):
        raise FactorError(f"batch: indices up to {batch.blocks[:, :3].max(axis=0)}, keys {limits}")
    n = keys.n
    compress = Compressor(keys, batch, loss, held)
    noise = gtsam.noiseModel.Unit.Create(n + 1)
    columns = keys.columns

    def error(values: Any) -> Array:
        e = np.zeros(n + 1)
        e[0] = math.sqrt(batch.total_loss(keys.read(values), loss))
        return e

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        R = compress(keys.read(values))
        return R[:, n], [R[:, c] for c in columns]

    return custom_factor("LaserSpotBatchFactor", noise, keys.keys, keys.dims, error, linearize)


class Compressor:
    """Square-root information of a batch at any state, with held coordinates and ties."""

    def __init__(
        self, keys: CellKeys, batch: SpotBatch, loss: Loss, held: npt.ArrayLike | None = None
    ) -> None:
        first = {key: c.start for key, c in zip(keys.keys, keys.columns, strict=True)}
        camera = np.array([[first[x], first[k]] for x, k in keys.cameras], dtype=np.int64)
        laser = np.array([first[x] for x in keys.lasers], dtype=np.int64)
        plane = np.array([first[x] for x in keys.planes], dtype=np.int64)
        c, l, p = batch.blocks[:, :3].T  # noqa: E741
        offsets = np.column_stack([camera[c], laser[l], plane[p]])
        mask = np.zeros(keys.n, np.bool_) if held is None else np.array(held, np.bool_)
        if mask.shape != (keys.n,):
            raise FactorError(f"held: expected ({keys.n},) booleans, got {mask.shape}")
        tied = [(i, a) for i, a in enumerate(keys.aspects) if a is not None]
        tie_from = np.array([camera[i, 1] for i, _ in tied], dtype=np.int64)
        mask[tie_from] = True
        ratio = np.array([a for _, a in tied], dtype=np.float64)
        self._data = (batch.pixels, batch.hands, batch.blocks, offsets, keys.n)
        self._tail = (
            LOSSES[loss.name],
            loss.threshold,
            mask,
            tie_from,
            tie_from + 1,
            ratio,
        )

    def __call__(self, state: State) -> Array:
        """Upper triangular ``R`` (n+1, n+1), ``R.T R = [J r]^T [J r]``; last column the residual.

        Raises
        ------
        FactorError
            A spot cannot be at this state (beam away from the plane, or behind the camera).
        """
        R = kernels.square_root_information(*self._data, *state, *self._tail)
        if not math.isfinite(R[0, 0]):
            raise FactorError("LaserSpotBatchFactor: " + _IMPOSSIBLE)
        return np.asarray(R)


def whitening_from_covariance(cov: Array) -> Array:
    """(N, 3) ``w00, w01, w11`` of upper triangular ``W`` with ``W.T W = inv(cov)``.

    Raises
    ------
    FactorError
        A covariance is not positive definite; names the first.
    """
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    with np.errstate(all="ignore"):
        det = a * c - b * b
        w00 = np.sqrt(c / det)
        out = np.column_stack([w00, -b / (det * w00), 1 / np.sqrt(c)])
    bad = ~((det > 0) & (c > 0) & np.isfinite(out).all(axis=1))
    if bad.any():
        k = int(np.argmax(bad))
        raise FactorError(f"cov_uv[{k}]: not positive definite: {cov[k].tolist()}")
    return out


def keys_for(
    cameras: int,
    lasers: int,
    planes: int,
    frames: Sequence[BeamFrame],
    aspects: Sequence[float | None] = (),
) -> CellKeys:
    """Conventional keys: ``x`` camera pose, ``k`` intrinsics, ``l`` beam, ``p`` plane."""
    return CellKeys(
        tuple((gtsam.symbol("x", c), gtsam.symbol("k", c)) for c in range(cameras)),
        tuple(gtsam.symbol("l", i) for i in range(lasers)),
        tuple(gtsam.symbol("p", i) for i in range(planes)),
        tuple(frames),
        tuple(aspects),
    )
