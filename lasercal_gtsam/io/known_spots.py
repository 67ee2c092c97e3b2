"""Which spots were taken already: by id, and whether the same id is still the same spot."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations

# The same number may differ in its last digits after another way through files.
_DECIMALS_POSE, _DECIMALS_PX, _DIGITS_SIGMA = 9, 6, 6


class _Known(NamedTuple):
    """One spot as digests: who and which pose, which pixel; and where it is."""

    pose: bytes
    pixel: bytes
    where: str


class KnownSpots:
    """Spots by id, small: a few digests each."""

    def __init__(self) -> None:
        self._spots: dict[str, list[_Known]] = {}

    def __len__(self) -> int:
        return len(self._spots)

    def __contains__(self, name: str) -> bool:
        return name in self._spots

    def add(self, observations: Observations, where: str) -> None:
        """Remember spots; ``where`` says for messages where they are ("calibration.json")."""
        for name, pose, pixel in _digests(observations):
            self._spots.setdefault(name, []).append(_Known(pose, pixel, where))

    def where(self, name: str) -> str:
        """Where a spot of that id is."""
        return self._spots[name][0].where

    def same(self, observations: Observations, pixels: bool = True) -> list[bool]:
        """Whether each spot, whose id is known, is one of those known by it.

        Poses and names are compared, and with ``pixels`` the pixels and their covariances.
        """
        return [
            any(
                known.pose == pose and (known.pixel == pixel or not pixels)
                for known in self._spots[name]
            )
            for name, pose, pixel in _digests(observations)
        ]


def _digests(observations: Observations) -> list[tuple[str, bytes, bytes]]:
    # adding 0.0 makes -0.0 and 0.0 the same bytes
    poses = np.round(observations.T_base_hand[:, :3], _DECIMALS_POSE) + 0.0
    pixels = np.round(observations.uv, _DECIMALS_PX) + 0.0
    return [
        (
            str(observations.id[k]),
            _digest(
                f"{observations.camera[k]}\0{observations.laser[k]}\0{observations.plane[k]}",
                poses[k].tobytes(),
            ),
            _digest(_sigmas(observations.cov_uv[k]), pixels[k].tobytes()),
        )
        for k in range(len(observations))
    ]


def _sigmas(cov: Array) -> str:
    if np.isnan(cov).any():
        return ""
    su, sv = np.sqrt(np.diag(cov)).tolist()
    rho = round(cov[0, 1] / (su * sv), _DIGITS_SIGMA) + 0.0
    return f"{su:.{_DIGITS_SIGMA}g} {sv:.{_DIGITS_SIGMA}g} {rho}"


def _digest(text: str, content: bytes) -> bytes:
    return hashlib.blake2b(text.encode() + b"\0" + content, digest_size=8).digest()
