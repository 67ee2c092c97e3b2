"""What was observed: for every spot its pixel, its hand pose, and who took part."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import check_image_size, check_pose
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import LARGEST, Array, FrozenData, set_array

Names = npt.NDArray[np.str_]
Index = npt.NDArray[np.int64]

# hand poses of one stop are the same number, but for rounding on the way (m; elements of rotations)
SAME_POSE = 1e-6


@dataclass(frozen=True, eq=False)
class Observations(FrozenData):
    """N spots, arrays over the spots. Build it with `from_arrays`.

    Attributes
    ----------
    uv : (N, 2) array
        Spot pixels, u right, v down, (0, 0) = centre of the top-left pixel.
    cov_uv : (N, 2, 2) array
        Covariance of each pixel, px^2. A row of NaN means that the spot has no covariance of
        its own: ``CalibrationOptions.sigma_px`` is used.
    T_base_hand : (N, 4, 4) array
        Hand poses, metres: hand coordinates into base coordinates.
    camera, laser, plane : (N,) arrays of str
        Names of the camera that saw, the laser that lit and the plane that carried the spot.
    id : (N,) array of str
        Label of each spot.
    image_size : dict
        Camera name to (width, height), pixels.
    stop : (N,) array of str, or None
        Spots with the same label were seen while the hand stood still at one pose (by two cameras,
        of two lasers, in several pictures), so that they share one error of the robot; "" for a
        spot by itself. None: every spot has an error of its own, as when the hand was moved between
        any two, also when it came back to the same pose. Matters where robot noise is stated or
        estimated.
    """

    uv: Array
    cov_uv: Array
    T_base_hand: Array
    camera: Names
    laser: Names
    plane: Names
    id: Names
    image_size: Mapping[str, tuple[int, int]]
    stop: Names | None = None

    def __post_init__(self) -> None:
        n = len(set_array(self, "uv", self.uv, (None, 2), largest=LARGEST))
        T = set_array(self, "T_base_hand", self.T_base_hand, (n, 4, 4), largest=LARGEST)
        check_pose(T, "T_base_hand")
        cov = set_array(self, "cov_uv", self.cov_uv, (n, 2, 2), finite=False)
        _check_covariances(cov)
        for name in ("camera", "laser", "plane", "id", "stop"):
            if name == "stop" and self.stop is None:
                continue
            values = np.array(getattr(self, name), dtype=np.str_)
            if values.shape != (n,):
                raise DataError(
                    f"Observations.{name}: expected {n} names, one a spot; got shape {values.shape}"
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        sizes = {str(k): check_image_size(v) for k, v in dict(self.image_size).items()}
        missing = sorted(set(self.cameras) - set(sizes))
        if missing:
            raise DataError(f"Observations.image_size: no size given for camera {missing[0]!r}")
        object.__setattr__(self, "image_size", sizes)
        _check_stops(self)

    @classmethod
    def from_arrays(
        cls,
        uv: npt.ArrayLike,
        T_base_hand: npt.ArrayLike,
        *,
        plane: str | Sequence[str],
        image_size: tuple[int, int] | Mapping[str, tuple[int, int]],
        camera: str | Sequence[str] = "camera",
        laser: str | Sequence[str] = "laser",
        id: Iterable[Any] | None = None,
        sigma_px: float | npt.ArrayLike | None = None,
        cov_uv: npt.ArrayLike | None = None,
        stop: Iterable[Any] | None = None,
    ) -> Observations:
        """Build from arrays; a single name stands for every spot.

        Parameters
        ----------
        uv : (N, 2) pixels
        T_base_hand : (N, 4, 4), metres
        plane, camera, laser : a name, or N names
        image_size : (width, height) px, or a dict from camera name to that
        id : N labels; "0", "1", ... if left out
        sigma_px : one sigma, or N of them (px); not together with ``cov_uv``
        cov_uv : (N, 2, 2) or (2, 2), px^2
        stop : N labels; the same for spots that were seen from one standing of the hand

        Raises
        ------
        DataError
            On wrong shapes, non-finite numbers, transforms that are not rigid, covariances that
            are not positive definite, stops whose spots have different hand poses.
        """
        pixels = np.asarray(uv, dtype=np.float64)
        n = len(pixels) if pixels.ndim else 0
        if sigma_px is not None and cov_uv is not None:
            raise DataError("Observations: give sigma_px or cov_uv, not both")
        if cov_uv is not None:
            cov = np.broadcast_to(np.asarray(cov_uv, dtype=np.float64), (n, 2, 2))
        elif sigma_px is not None:
            sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (n,))
            if not np.all(sigma > 0):
                raise DataError(f"Observations: sigma_px must be positive, got {sigma.min()}")
            cov = sigma[:, None, None] ** 2 * np.eye(2)
        else:
            cov = np.full((n, 2, 2), np.nan)
        cameras = _names(camera, n)
        if not isinstance(image_size, Mapping):
            image_size = {str(name): image_size for name in np.unique(cameras)}
        return cls(
            uv=pixels,
            cov_uv=cov,
            T_base_hand=np.asarray(T_base_hand, dtype=np.float64),
            camera=cameras,
            laser=_names(laser, n),
            plane=_names(plane, n),
            id=np.array([str(i) for i in (range(n) if id is None else id)], dtype=np.str_),
            image_size=image_size,
            stop=None if stop is None else np.array([str(i) for i in stop], dtype=np.str_),
        )

    def __len__(self) -> int:
        return len(self.uv)

    def __getitem__(self, which: Any) -> Observations:
        """Select spots by a boolean mask, an index array or a slice."""
        rows = np.atleast_1d(np.arange(len(self))[which])
        return Observations(
            uv=self.uv[rows],
            cov_uv=self.cov_uv[rows],
            T_base_hand=self.T_base_hand[rows],
            camera=self.camera[rows],
            laser=self.laser[rows],
            plane=self.plane[rows],
            id=self.id[rows],
            image_size=self.image_size,
            stop=None if self.stop is None else self.stop[rows],
        )

    def __add__(self, other: Observations) -> Observations:
        """Both sets of spots, in order; the image sizes must agree.

        A stop of the same name is the same stop in both.
        """
        for name in set(self.image_size) & set(other.image_size):
            if self.image_size[name] != other.image_size[name]:
                raise DataError(
                    f"Observations: camera {name!r} has image size {self.image_size[name]} in one "
                    f"set and {other.image_size[name]} in the other"
                )
        return Observations(
            uv=np.concatenate([self.uv, other.uv]),
            cov_uv=np.concatenate([self.cov_uv, other.cov_uv]),
            T_base_hand=np.concatenate([self.T_base_hand, other.T_base_hand]),
            camera=np.concatenate([self.camera, other.camera]),
            laser=np.concatenate([self.laser, other.laser]),
            plane=np.concatenate([self.plane, other.plane]),
            id=np.concatenate([self.id, other.id]),
            image_size={**self.image_size, **other.image_size},
            stop=_joined_stops(self, other),
        )

    @cached_property
    def _encoded(self) -> dict[str, tuple[tuple[str, ...], Index]]:
        return {name: _encode(getattr(self, name)) for name in ("camera", "laser", "plane")}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, sorted."""
        return self._encoded["camera"][0]

    @property
    def lasers(self) -> tuple[str, ...]:
        """Names of the lasers, sorted."""
        return self._encoded["laser"][0]

    @property
    def planes(self) -> tuple[str, ...]:
        """Names of the planes, sorted (numbers by value)."""
        return self._encoded["plane"][0]

    @property
    def camera_index(self) -> Index:
        """(N,) index of each spot's camera in `cameras`."""
        return self._encoded["camera"][1]

    @property
    def laser_index(self) -> Index:
        """(N,) index of each spot's laser in `lasers`."""
        return self._encoded["laser"][1]

    @property
    def plane_index(self) -> Index:
        """(N,) index of each spot's plane in `planes`."""
        return self._encoded["plane"][1]

    @cached_property
    def shared_stops(self) -> tuple[Index, ...]:
        """Stops with several spots, by their number k: for each k > 1 (G, k) spots of G stops."""
        if self.stop is None:
            return ()
        _, which, counts = np.unique(self.stop, return_inverse=True, return_counts=True)
        order = np.argsort(which, kind="stable").astype(np.int64)
        members = np.split(order, np.cumsum(counts)[:-1])
        shared = [m for m in members if len(m) > 1 and self.stop[m[0]]]
        sizes = sorted({len(m) for m in shared})
        return tuple(np.array([m for m in shared if len(m) == k]) for k in sizes)


def _names(value: str | Sequence[str], n: int) -> Names:
    return np.array([value] * n if isinstance(value, str) else value, dtype=np.str_)


def natural_key(name: str) -> tuple[int, int, str]:
    """Sort key that puts numbers first and in order: '2' before '10' before 'table'."""
    return (0, int(name), name) if name.isdecimal() else (1, 0, name)


def _encode(values: Names) -> tuple[tuple[str, ...], Index]:
    unique, inverse = np.unique(values, return_inverse=True)
    names = sorted((str(x) for x in unique), key=natural_key)
    rank = {name: i for i, name in enumerate(names)}
    index = np.array([rank[str(x)] for x in unique], dtype=np.int64)[inverse]
    index.flags.writeable = False
    return tuple(names), index


def _joined_stops(a: Observations, b: Observations) -> Names | None:
    if a.stop is None and b.stop is None:
        return None
    parts = [np.full(len(x), "", dtype="<U1") if x.stop is None else x.stop for x in (a, b)]
    return np.concatenate(parts)


def _check_stops(observations: Observations) -> None:
    """One standing of the hand is one pose."""
    T = observations.T_base_hand
    for members in observations.shared_stops:
        apart = np.abs(T[members] - T[members[:, :1]]).max(axis=(1, 2, 3))
        if np.any(apart > SAME_POSE):
            first = members[int(np.argmax(apart > SAME_POSE))]
            label, ids = str(observations.stop[first[0]]), observations.id[first].tolist()  # type: ignore[index]
            raise DataError(
                f"Observations.stop: the spots of stop {label!r} ({', '.join(ids)}) have hand "
                f"poses that differ by up to {apart.max():.2g} (m, or elements of the rotation); a "
                "stop is one standing of the hand: give its spots one pose, or labels of their own"
            )


def _check_covariances(cov: Array) -> None:
    unknown = np.isnan(cov).all(axis=(1, 2))
    a, b, c, d = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 0], cov[:, 1, 1]
    with np.errstate(invalid="ignore"):
        good = (a > 0) & (d > 0) & (a * d - b * c > 0) & (np.abs(b - c) <= 1e-9 * (a + d))
        good &= np.isfinite(cov).all(axis=(1, 2))
    bad = ~(good | unknown)
    if bad.any():
        k = int(np.argmax(bad))
        raise DataError(
            f"Observations.cov_uv[{k}]: expected a symmetric positive definite 2x2 matrix (px^2), "
            f"got {cov[k].tolist()}"
        )
