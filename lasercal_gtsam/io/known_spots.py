"""Which spots were taken already: by id, and whether the same id is still the same spot."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations

_DIGEST = 8  # bytes
# The same number may differ in its last digits after another way through files.
_DECIMALS_POSE, _DECIMALS_PX, _DIGITS_SIGMA = 9, 6, 6


class KnownSpots:
    """Spots by id, small: two digests each (who and which pose; which pixel) and where it is."""

    def __init__(self) -> None:
        # one record after the other where an id is there more than once
        self._spots: dict[str, bytes] = {}
        self._places: list[str] = []

    def __len__(self) -> int:
        return len(self._spots)

    def __contains__(self, name: str) -> bool:
        return name in self._spots

    def add(self, observations: Observations, where: str) -> None:
        """Remember spots; ``where`` says for messages where they are ("calibration.json")."""
        if where not in self._places:
            self._places.append(where)
        place = bytes([self._places.index(where)])
        poses, pixels = _poses(observations), _pixels(observations.uv, observations.cov_uv)
        for name, pose, pixel in zip(observations.id.tolist(), poses, pixels, strict=True):
            self._spots[name] = self._spots.get(name, b"") + pose + pixel + place

    def where(self, name: str) -> str:
        """Where a spot of that id is."""
        return self._places[self._spots[name][2 * _DIGEST]]

    def same_poses(self, observations: Observations) -> list[bool]:
        """Whether each spot has pose, camera, laser and plane of the one known by its id."""
        poses = _poses(observations)
        return [
            any(known[:_DIGEST] == pose for known in self._known(name))
            for name, pose in zip(observations.id.tolist(), poses, strict=True)
        ]

    def same_pixels(self, names: Sequence[str], uv: Array, cov_uv: Array) -> list[bool]:
        """Whether each spot has pixel and covariance of the one known by its id."""
        pixels = _pixels(uv, cov_uv)
        return [
            any(known[_DIGEST:] == pixel for known in self._known(name))
            for name, pixel in zip(names, pixels, strict=True)
        ]

    def same(self, observations: Observations) -> list[bool]:
        """Whether each spot is the one known by its id, in all that is measured."""
        poses, pixels = _poses(observations), _pixels(observations.uv, observations.cov_uv)
        return [
            pose + pixel in self._known(name)
            for name, pose, pixel in zip(observations.id.tolist(), poses, pixels, strict=True)
        ]

    def _known(self, name: str) -> list[bytes]:
        """Both digests of each spot of that id."""
        spots, size = self._spots[name], 2 * _DIGEST + 1
        return [spots[k : k + size - 1] for k in range(0, len(spots), size)]


def _poses(observations: Observations) -> list[bytes]:
    # adding 0.0 makes -0.0 and 0.0 the same bytes
    numbers = np.round(observations.T_base_hand[:, :3], _DECIMALS_POSE) + 0.0
    names = zip(
        observations.camera.tolist(),
        observations.laser.tolist(),
        observations.plane.tolist(),
        strict=True,
    )
    return [_digest("\0".join(who), T.tobytes()) for who, T in zip(names, numbers, strict=True)]


def _pixels(uv: Array, cov_uv: Array) -> list[bytes]:
    numbers = np.round(uv, _DECIMALS_PX) + 0.0
    return [_digest(_sigmas(cov), p.tobytes()) for p, cov in zip(numbers, cov_uv, strict=True)]


def _sigmas(cov: Array) -> str:
    if np.isnan(cov).any():
        return ""
    su, sv = np.sqrt(np.diag(cov)).tolist()
    rho = round(cov[0, 1] / (su * sv), _DIGITS_SIGMA) + 0.0
    return f"{su:.{_DIGITS_SIGMA}g} {sv:.{_DIGITS_SIGMA}g} {rho}"


def _digest(text: str, content: bytes) -> bytes:
    return hashlib.blake2b(text.encode() + b"\0" + content, digest_size=_DIGEST).digest()
