"""The same problem with the hand poses as variables, for somebody's own GTSAM graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
from lasercal_factors.spot import CellKeys, keys_for
from lasercal_factors.spot_hand import LaserSpotHandFactor
from lasercal_factors.wrap import custom_factor

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import beam_frames
from lasercal_gtsam.hand_noise.elimination import moved_hands, stops_by_size
from lasercal_gtsam.hand_noise.poses import Noisy
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Index

# sigma of a part of the hand pose that has no noise (m, rad): small beside any that matters
_EXACT = 1e-9


@dataclass(frozen=True, eq=False)
class HandPoseGraph:
    """A graph with one `Pose3` for every stop, and values to begin with: the calibration's.

    Attributes
    ----------
    graph : a factor for each spot, a prior for each hand pose, pins for what is held
    values : the calibrated cell and the likeliest hand poses
    cell : keys of the cell's variables, with the beams' constant frames
    hands : keys of the hand poses
    hand_of_spot : (N,) index into ``hands`` of each spot, -1 for one that was left out
    unit : factor on all sigmas that the residuals gave; GTSAM's marginals are without it
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    cell: CellKeys
    hands: tuple[int, ...]
    hand_of_spot: Index
    unit: float


def hand_pose_graph(calibration: Calibration) -> HandPoseGraph:
    """Pose a calibration with robot noise as a graph with explicit hand poses.

    Variables: as in `lasercal_factors.spot`, and ``h`` for every stop's ``T_base_hand``. The graph
    can be extended with factors of one's own before it is solved.

    Raises
    ------
    DataError
        No robot noise was stated or found (`poses.Noisy`); focal lengths are tied, or priors are on
        rows of the table: these are not variables of such a graph.
    """
    told = Noisy.of(calibration)
    seen, cell, options = told.observations, told.cell, calibration.options_used
    holds = resolve_holds(seen, options, cell)
    if holds.aspect or holds.priors:
        raise DataError(
            "hand_pose_graph: tied focal lengths (known aspect) and priors on rows of the table "
            "cannot be said with these variables; leave them out"
        )
    frames = tuple(beam_frames(cell).values())
    keys = keys_for(len(cell.cameras), len(cell.lasers), len(cell.planes), frames)
    # what the fit held, be it by the options or on its way
    held = np.diag(calibration.covariance) == 0.0
    graph, values = gtsam.NonlinearFactorGraph(), _cell_values(keys, cell)
    poses = moved_hands(seen.T_base_hand, told.corrections())
    variances = told.noise.variances[[3, 4, 5, 0, 1, 2]]
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(np.sqrt(variances), _EXACT))
    hand_of_spot = np.full(len(seen), -1, dtype=np.int64)
    stops = [stop for group in stops_by_size(seen, told.kept) for stop in group]
    hands = tuple(gtsam.symbol("h", number) for number in range(len(stops)))
    for number, (hand, stop) in enumerate(zip(hands, stops, strict=True)):
        hand_of_spot[stop] = number
        values.insert(hand, gtsam.Pose3(poses[stop[0]]))
        commanded = gtsam.Pose3(seen.T_base_hand[stop[0]])
        graph.add(gtsam.PriorFactorPose3(hand, commanded, prior))
        for k in stop.tolist():
            c, l, p = seen.camera_index[k], seen.laser_index[k], seen.plane_index[k]  # noqa: E741
            parts = (*keys.cameras[int(c)], keys.lasers[int(l)], keys.planes[int(p)])
            columns = _columns(keys, int(c), int(l), int(p))
            spot = seen.uv[k], frames[int(l)], told.cov_uv[k], held[columns]
            graph.add(LaserSpotHandFactor(*parts, hand, *spot))
    for pin in _pins(keys, held):
        graph.add(pin)
    return HandPoseGraph(graph, values, keys, hands, hand_of_spot, told.unit)


def _columns(keys: CellKeys, c: int, l: int, p: int) -> Index:  # noqa: E741
    """Columns of one spot's parts in the cell's coordinates."""
    cameras, lasers = len(keys.cameras), len(keys.lasers)
    which = (2 * c, 2 * c + 1, 2 * cameras + l, 2 * cameras + lasers + p)
    return np.concatenate([np.arange(keys.n)[keys.columns[i]] for i in which])


def _cell_values(keys: CellKeys, cell: Any) -> gtsam.Values:
    values = gtsam.Values()
    for (pose, lens), camera in zip(keys.cameras, cell.cameras.values(), strict=True):
        values.insert(pose, gtsam.Pose3(camera.T_base_camera))
        values.insert(lens, camera.intrinsics.to_gtsam())
    for key, frame, beam in zip(keys.lasers, keys.frames, cell.lasers.values(), strict=True):
        values.insert(key, frame.coordinates(beam.direction_hand, beam.point_hand))
    for key, plane in zip(keys.planes, cell.planes.values(), strict=True):
        n, d = plane.normal_base, plane.distance
        values.insert(key, gtsam.OrientedPlane3(gtsam.Unit3(n), -d))
    return values


def _pins(keys: CellKeys, held: npt.NDArray[np.bool_]) -> list[gtsam.CustomFactor]:
    """Factors without an error that keep what nothing else moves from being undetermined."""
    pins = []
    for key, dim, columns in zip(keys.keys, keys.dims, keys.columns, strict=True):
        rows = np.eye(dim)[held[columns]]
        if len(rows):
            pins.append(_pin(key, rows))
    return pins


def _pin(key: int, rows: Array) -> gtsam.CustomFactor:
    noise = gtsam.noiseModel.Unit.Create(len(rows))
    zero = np.zeros(len(rows))
    return custom_factor(
        "held", noise, [key], [rows.shape[1]], lambda _: zero, lambda _: (zero, [rows])
    )
