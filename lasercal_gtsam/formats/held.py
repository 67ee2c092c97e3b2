"""What a file says in this package's conventions, and whether that is what it should say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np

from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array

Key = TypeVar("Key", str, tuple[str, str])

# elements of rotations, metres relative to the distance (at least 1 m), intrinsics relative
POSE_TOLERANCE = 1e-12
# of an element, relative to the two sigmas it belongs to
COVARIANCE_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Held:
    """Content of a file; empty or None where the format says nothing.

    Attributes
    ----------
    poses : camera to ``T_base_camera`` (4, 4), metres; a format without names uses ""
    relative : (to, from) to the transform (4, 4) between two cameras, metres
    intrinsics, image_size : by camera, px
    frames : names of parent and child frame
    covariance, labels : (n, n) in the tangent coordinates of `report_map`, and their names; of a
        single camera the labels may lack its name ("rot_x" for "camera.rot_x")
    """

    poses: Mapping[str, Array] = field(default_factory=dict)
    relative: Mapping[tuple[str, str], Array] = field(default_factory=dict)
    intrinsics: Mapping[str, Intrinsics] = field(default_factory=dict)
    image_size: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    frames: tuple[str, str] | None = None
    covariance: Array | None = None
    labels: tuple[str, ...] = ()


class Written(NamedTuple):
    """What a writer gives: the content, what it must hold, and words on what was left out."""

    content: bytes
    wanted: Held
    notes: tuple[str, ...] = ()


def pose_difference(found: Array, wanted: Array) -> float:
    """Largest difference of two transforms (4, 4): rotation elements, and metres by distance."""
    scale = max(1.0, float(np.linalg.norm(wanted[:3, 3])))
    turned = np.abs(found[:3, :3] - wanted[:3, :3]).max()
    moved = np.abs(found[:3, 3] - wanted[:3, 3]).max() / scale
    return float(max(turned, moved))


def covariance_difference(found: Array, wanted: Array) -> float:
    """Largest difference of an element of two covariances, in units of its two sigmas.

    Where a coordinate has no sigma (it was held) the difference must be none at all. NaN, which
    stands for "not known", equals NaN.
    """
    sigma = np.sqrt(np.abs(np.diag(wanted)))
    same = (found == wanted) | (np.isnan(found) & np.isnan(wanted))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(same, 0.0, np.abs(found - wanted) / np.outer(sigma, sigma))
    return float(np.max(ratio, initial=0.0))


def check_same(found: Held, wanted: Held) -> None:
    """Raise `DataError` where a file, read back, says something else than it was to say.

    Compares what ``wanted`` has; the file must have all of it.
    """
    problems = [
        *_pose_problems("pose of", found.poses, wanted.poses),
        *_pose_problems("transform", found.relative, wanted.relative),
        *_intrinsics_problems(found, wanted),
    ]
    if found.image_size != wanted.image_size:
        problems.append(f"image sizes {found.image_size}, expected {wanted.image_size}")
    if found.frames != wanted.frames:
        problems.append(f"frames {found.frames}, expected {wanted.frames}")
    if wanted.covariance is not None:
        problems += _covariance_problems(found, wanted)
    if problems:
        raise DataError(
            "the content, read back by the format's own rules, is not what it should be; nothing "
            "was written: " + "; ".join(problems)
        )


def _pose_problems(what: str, found: Mapping[Key, Array], wanted: Mapping[Key, Array]) -> list[str]:
    if found.keys() != wanted.keys():
        return [f"{what}: {sorted(found)}, expected {sorted(wanted)}"]
    problems = []
    for name, T in wanted.items():
        difference = pose_difference(found[name], T)
        if not difference <= POSE_TOLERANCE:
            problems.append(f"{what} {name} differs by {difference:.2g}")
    return problems


def _intrinsics_problems(found: Held, wanted: Held) -> list[str]:
    if found.intrinsics.keys() != wanted.intrinsics.keys():
        return [f"intrinsics of {sorted(found.intrinsics)}, expected {sorted(wanted.intrinsics)}"]
    problems = []
    for name, intrinsics in wanted.intrinsics.items():
        values = intrinsics.vector
        difference = np.abs(found.intrinsics[name].vector - values) / np.maximum(np.abs(values), 1)
        if not difference.max() <= POSE_TOLERANCE:
            problems.append(f"intrinsics of {name!r} differ by {difference.max():.2g}")
    return problems


def _covariance_problems(found: Held, wanted: Held) -> list[str]:
    if found.covariance is None or wanted.covariance is None:
        return ["the covariance is missing"]
    if found.labels != wanted.labels or found.covariance.shape != wanted.covariance.shape:
        return [f"covariance of {found.labels}, expected {wanted.labels}"]
    difference = covariance_difference(found.covariance, wanted.covariance)
    if not difference <= COVARIANCE_TOLERANCE:
        return [f"covariance differs by {difference:.2g} of its sigmas"]
    return []
