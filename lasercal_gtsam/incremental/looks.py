"""What the change detector is given for a spot, and what it answers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from lasercal_factors.change_arrays import Looks

from lasercal_gtsam.frozen import Array


class Look(NamedTuple):
    """A spot as it came, compared with what was expected before it was used.

    Attributes
    ----------
    e : (2,) whitened innovation, identity covariance where nothing has changed; NaN where the
        estimate says that no spot should be
    camera, laser, plane : indices of the parts
    by_camera : (2, 6) whitened derivative of the pixel by rotation (rad) and translation (m)
    by_laser : (2, 4) by slopes (rad) and offsets (m)
    by_plane : (2, 3) by tilt (rad) and distance (m)
    area : of the picture in whitened units: width * height / sqrt(det covariance)
    dof : degrees of freedom of the noise scale; inf where the noise is known
    """

    e: npt.ArrayLike
    camera: int
    laser: int
    plane: int
    by_camera: npt.ArrayLike
    by_laser: npt.ArrayLike
    by_plane: npt.ArrayLike
    area: float
    dof: float


class Verdict(NamedTuple):
    """What a spot says.

    Attributes
    ----------
    outlier : more probably a gross outlier than a good spot of an unchanged cell
    reason : why, with its length and the limit; "" for a good spot
    alarm : something has changed
    since : number of the first spot that is affected, counted from the detector's start at 0; None
        without an alarm
    statistic : evidence for a change, as a fraction of the threshold on a logarithmic scale: alarm
        at 1
    length, limit : of the innovation (sigma) and from which on a spot is an outlier
    """

    outlier: bool
    reason: str
    alarm: bool
    since: int | None
    statistic: float
    length: float
    limit: float


class Onset(NamedTuple):
    """A cause and a spot it may have begun with: kind, index, first spot, log weight."""

    kind: str
    part: int
    first: int
    log_weight: float


def plain(looks: Looks) -> Looks:
    """Arrays of the types that are compiled for."""
    return Looks(
        np.ascontiguousarray(looks.e, dtype=np.float64),
        np.ascontiguousarray(looks.who, dtype=np.int64),
        np.ascontiguousarray(looks.by_camera, dtype=np.float64),
        np.ascontiguousarray(looks.by_laser, dtype=np.float64),
        np.ascontiguousarray(looks.by_plane, dtype=np.float64),
        np.ascontiguousarray(looks.area, dtype=np.float64),
        np.ascontiguousarray(looks.dof, dtype=np.float64),
    )


def single(spot: Look) -> Looks:
    """One spot as arrays."""

    def row(value: npt.ArrayLike) -> Array:
        return np.asarray(value, dtype=np.float64)[None]

    return Looks(
        row(spot.e),
        np.array([[spot.camera, spot.laser, spot.plane]], dtype=np.int64),
        row(spot.by_camera),
        row(spot.by_laser),
        row(spot.by_plane),
        np.array([spot.area], dtype=np.float64),
        np.array([spot.dof], dtype=np.float64),
    )
