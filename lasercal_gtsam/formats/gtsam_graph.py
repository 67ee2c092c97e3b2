"""A calibration for somebody's own GTSAM graph: values, and one prior with the joint covariance.

Variables as in `lasercal_factors.spot`: a camera's pose `Pose3` (``T_base_camera``) and `Cal3DS2`,
a beam as 4-vector about a constant `BeamFrame`, a plane as `OrientedPlane3` with GTSAM's
``n.x + d = 0``. The covariance is in the tangent spaces GTSAM gives them, which are this package's
but for the sign of a plane's distance. GTSAM cannot serialise an `OrientedPlane3`, nor a custom
factor: the file holds arrays, and `load_gtsam` builds the objects.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gtsam
import numpy as np
from lasercal_factors.arrays import State
from lasercal_factors.beam import BeamFrame
from lasercal_factors.chart import CellChart
from lasercal_factors.errors import FactorError
from lasercal_factors.spot import CellKeys, keys_for
from lasercal_factors.wrap import custom_factor

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.plain_data import npz_bytes
from lasercal_gtsam.formats.source import Source
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.io.files import read_bytes
from lasercal_gtsam.report_map import BEAM_TANGENT, CAMERA_TANGENT, PLANE_TANGENT, tangent_labels
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_log

FORMAT = "lasercal-gtsam-prior"
# What is held has no sigma, and a graph cannot have an infinite weight: its prior has this one,
# in metres, radians and pixels. Much smaller ones lose the joint marginals to rounding.
HELD_SIGMA = 1e-6
# Eigenvalue of the correlations below which nothing is free along a direction (tied focal lengths),
# and the sigma it has instead, as a share of the sigmas of what is tied: enough to hold it, and not
# so stiff that GTSAM's Cholesky decomposition fails.
_NULL, TIED_SHARE = 1e-12, 1e-3
# Rounding leaves eigenvalues of correlations below this under 0; less is a mistake.
_NOT_A_COVARIANCE = 1e-9


@dataclass(frozen=True, eq=False)
class GtsamPrior:
    """What a calibration knows, as a graph takes it.

    Attributes
    ----------
    keys : keys of the variables, with the beams' constant frames; made for
        `lasercal_factors.LaserSpotBatchFactor` as well
    state : the mean as plain arrays
    covariance : (n, n) in the order of ``keys.keys`` and in GTSAM's tangent spaces; SI units, px.
        Zero rows where the calibration held a value
    cameras, lasers, planes : names in the order of the keys
    image_size : of each camera, px
    """

    keys: CellKeys
    state: State
    covariance: Array
    cameras: tuple[str, ...]
    lasers: tuple[str, ...]
    planes: tuple[str, ...]
    image_size: tuple[tuple[int, int], ...]

    @property
    def values(self) -> gtsam.Values:
        """The mean: a new `gtsam.Values`."""
        values, state = gtsam.Values(), self.state
        for c, (pose, lens) in enumerate(self.keys.cameras):
            values.insert(pose, gtsam.Pose3(gtsam.Rot3(state.cam_R[c]), state.cam_t[c]))
            values.insert(lens, gtsam.Cal3DS2(*state.cam_K[c]))
        for key, line in zip(self.keys.lasers, state.beam_l, strict=True):
            values.insert(key, line)
        for key, n, d in zip(self.keys.planes, state.plane_n, state.plane_d, strict=True):
            values.insert(key, gtsam.OrientedPlane3(gtsam.Unit3(n), -d))
        return values

    @cached_property
    def square_root_information(self) -> Array:
        """(n, n) ``R`` with ``R^T R`` the inverse covariance; see `factor` on held values."""
        held = np.diag(self.covariance) <= 0
        covariance = self.covariance + HELD_SIGMA**2 * np.diag(held)
        scale = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(scale, scale)
        found, axes = np.linalg.eigh(0.5 * (correlation + correlation.T))
        if found[0] < -_NOT_A_COVARIANCE:
            raise DataError("the covariance has a negative eigenvalue: it is no covariance")
        tied = found < _NULL * float(found[-1])
        sigma = np.where(tied, TIED_SHARE, np.sqrt(np.abs(found)))
        return np.asarray((axes / sigma).T / scale)

    @property
    def factor(self) -> gtsam.CustomFactor:
        """The joint prior, one factor on all keys: mean and covariance as above.

        The error is the chart's coordinates about the mean: of a camera's pose rotation and
        translation apart, as `CellChart` has them, not the coupled logarithm of `Pose3`. Both have
        the same covariance; far from the mean they bend differently. What was held is pinned with
        a sigma of `HELD_SIGMA`, what was tied with `TIED_SHARE` of its sigmas.
        """
        keys, chart, whiten = self.keys, CellChart(self.state), self.square_root_information
        signs = _signs(keys)

        def error(values: Any) -> Array:
            z = _coordinates(chart.reference, keys.read(values))
            if not np.isfinite(z).all():
                return np.full(keys.n, np.inf)
            return np.asarray(whiten @ (signs * z))

        def linearize(values: Any) -> tuple[Array, list[Array]]:
            z = _coordinates(chart.reference, keys.read(values))
            if not np.isfinite(z).all():
                raise FactorError("calibration prior: a plane's normal is turned by 90 deg or more")
            J = whiten @ (signs[:, None] * np.linalg.inv(chart.tangent_map(z)) * signs)
            return whiten @ (signs * z), [J[:, columns] for columns in keys.columns]

        noise = gtsam.noiseModel.Unit.Create(keys.n)
        return custom_factor("calibration prior", noise, keys.keys, keys.dims, error, linearize)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """A new graph with the factor in it."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self.factor)
        return graph

    def rekeyed(self, keys: Sequence[int]) -> GtsamPrior:
        """The same on other keys, given in the order of ``keys.keys``.

        Raises
        ------
        DataError
            Not as many keys as variables, or one twice.
        """
        if len(keys) != len(self.keys.keys) or len(set(keys)) < len(keys):
            raise DataError(f"keys: expected {len(self.keys.keys)} different ones, got {[*keys]}")
        given = iter(keys)
        cameras = tuple((next(given), next(given)) for _ in self.cameras)
        lasers = tuple(next(given) for _ in self.lasers)
        return replace(self, keys=CellKeys(cameras, lasers, tuple(given), self.keys.frames))

    def covariance_of(self, *keys: int) -> Array:
        """Joint covariance of these keys' variables, in their order."""
        where = dict(zip(self.keys.keys, self.keys.columns, strict=True))
        rows = np.concatenate([np.arange(self.keys.n)[where[key]] for key in keys])
        return np.asarray(self.covariance[np.ix_(rows, rows)])


def to_gtsam(calibration: Calibration, parts: Sequence[str] | None = None) -> GtsamPrior:
    """Values and a joint prior for a GTSAM graph.

    Parameters
    ----------
    calibration : the result
    parts : ``"camera:<name>"``, ``"laser:<name>"``, ``"plane:<name>"`` that are wanted, the others
        marginalised out; None: all that were calibrated

    Returns
    -------
    GtsamPrior
        Keys are ``x0 k0 x1 k1 ...`` for the cameras, ``l0 ...`` and ``p0 ...`` for lasers and
        planes, counted among the parts that are wanted; `GtsamPrior.rekeyed` gives others.

    Raises
    ------
    DataError
        An unknown part, or one without a covariance.
    """
    return _prior(calibration.cell, calibration.covariance, calibration.labels, parts)


def load_gtsam(path: str | Path) -> GtsamPrior:
    """Read what ``lasercal export CALIBRATION gtsam`` writes.

    Raises
    ------
    DataError
        Not readable, or not such a file.
    """
    try:
        return _read(read_bytes(path))
    except (ValueError, OSError, KeyError, EOFError, BadZipFile, DataError) as error:
        raise DataError(f"{path}: not a file of the format gtsam: {error}") from None


def write_gtsam(source: Source) -> Written:
    """The prior's arrays."""
    cell = source.cell
    parts = [f"camera:{name}" for name in source.cameras]
    parts += [f"laser:{name}" for name in cell.lasers] + [f"plane:{name}" for name in cell.planes]
    observed = {*_observed(cell, source.labels)}
    prior = _prior(cell, source.covariance, source.labels, [p for p in parts if p in observed])
    keys, state = prior.keys, prior.state
    arrays = {
        "format": FORMAT,
        "remarks": [*source.remarks, "covariance: in the order of keys, in GTSAM's tangent spaces"],
        "base_frame": source.parent,
        "keys": [gtsam.DefaultKeyFormatter(key) for key in keys.keys],
        "cameras": list(prior.cameras),
        "lasers": list(prior.lasers),
        "planes": list(prior.planes),
        "image_size": list(prior.image_size),
        "R_base_camera": state.cam_R,
        "t_base_camera_m": state.cam_t,
        "Cal3DS2": state.cam_K,
        "beam_frame_R": state.beam_R,
        "beam_frame_t_m": state.beam_t,
        "beam_vector": state.beam_l,
        "OrientedPlane3": np.column_stack([state.plane_n, -state.plane_d]),
        "covariance": prior.covariance,
    }
    left = sorted(set(parts) - observed)
    notes = (f"{', '.join(left)}: nothing was observed of them: left out",) if left else ()
    return Written(npz_bytes(arrays), _wanted(source, prior), notes)


def read_gtsam(content: bytes) -> Held:
    """What `gtsam.Values` of the file hold, taken out through GTSAM's own accessors."""
    return _held(_read(content))


def _read(content: bytes) -> GtsamPrior:
    with np.load(io.BytesIO(content), allow_pickle=False) as data:
        if str(data["format"]) != FORMAT:
            raise DataError(f"expected format {FORMAT!r}, got {str(data['format'])!r}")
        R, t, planes = data["beam_frame_R"], data["beam_frame_t_m"], data["OrientedPlane3"]
        names = {k: tuple(map(str, data[k])) for k in ("cameras", "lasers", "planes")}
        state = State(
            data["R_base_camera"].reshape(-1, 3, 3),
            data["t_base_camera_m"].reshape(-1, 3),
            data["Cal3DS2"].reshape(-1, 9),
            R.reshape(-1, 3, 3),
            t.reshape(-1, 3),
            data["beam_vector"].reshape(-1, 4),
            planes.reshape(-1, 4)[:, :3].copy(),
            -planes.reshape(-1, 4)[:, 3],
        )
        sizes = tuple((int(w), int(h)) for w, h in data["image_size"].reshape(-1, 2))
        prior = GtsamPrior(_keys(state), state, data["covariance"], **names, image_size=sizes)
        if prior.covariance.shape != (prior.keys.n, prior.keys.n):
            raise DataError(f"covariance of shape {prior.covariance.shape}")
        return prior


def _prior(
    cell: Cell, covariance: Array, labels: tuple[str, ...], parts: Sequence[str] | None
) -> GtsamPrior:
    observed = _observed(cell, labels)
    wanted = list(observed) if parts is None else list(parts)
    for part in wanted:
        if part not in observed:
            raise DataError(
                f"{part!r} is no part with a covariance; there are {', '.join(observed)}"
            )
    chosen = Cell(
        {k: v for k, v in cell.cameras.items() if f"camera:{k}" in wanted},
        {k: v for k, v in cell.lasers.items() if f"laser:{k}" in wanted},
        {k: v for k, v in cell.planes.items() if f"plane:{k}" in wanted},
    )
    if not wanted:
        raise DataError("no part is wanted: a prior needs one at least")
    rows = [labels.index(label) for label in tangent_labels(chosen)]
    block = covariance[np.ix_(rows, rows)]
    if not np.isfinite(block).all():
        raise DataError(
            "the calibration has no sigmas (no degrees of freedom were left): it cannot be a prior"
        )
    state = _state(chosen)
    keys = _keys(state)
    signs = _signs(keys)
    return GtsamPrior(
        keys,
        state,
        block * np.outer(signs, signs),
        tuple(chosen.cameras),
        tuple(chosen.lasers),
        tuple(chosen.planes),
        tuple(camera.image_size for camera in chosen.cameras.values()),
    )


def _observed(cell: Cell, labels: tuple[str, ...]) -> list[str]:
    """Parts that have a covariance."""
    known = set(labels)
    found = [f"camera:{k}" for k in cell.cameras if f"{k}.{CAMERA_TANGENT[0]}" in known]
    found += [f"laser:{k}" for k in cell.lasers if f"{k}.{BEAM_TANGENT[0]}" in known]
    return found + [f"plane:{k}" for k in cell.planes if f"plane {k}.{PLANE_TANGENT[0]}" in known]


def _state(cell: Cell) -> State:
    """Arrays of a cell that may lack a kind of part."""
    state = state_from_cell(cell)
    shapes = ((3, 3), (3,), (9,), (3, 3), (3,), (4,), (3,), ())
    return State(*(a.reshape(-1, *shape) for a, shape in zip(state, shapes, strict=True)))


def _keys(state: State) -> CellKeys:
    frames = [BeamFrame(R, t) for R, t in zip(state.beam_R, state.beam_t, strict=True)]
    return keys_for(len(state.cam_R), len(frames), len(state.plane_d), frames)


def _signs(keys: CellKeys) -> Array:
    signs = np.ones(keys.n)
    first = keys.n - len(PLANE_TANGENT) * len(keys.planes)
    signs[first + 2 :: len(PLANE_TANGENT)] = -1.0
    return signs


def _coordinates(reference: State, state: State) -> Array:
    """Chart coordinates (n,) of ``state`` about ``reference``: the inverse of `CellChart.state`.

    Infinite where a plane's normal is turned by 90 deg or more: that is another plane.
    """
    parts: list[Array] = []
    for c, R in enumerate(reference.cam_R):
        parts += [
            rotation_log(R.T @ state.cam_R[c]),
            R.T @ (state.cam_t[c] - reference.cam_t[c]),
            state.cam_K[c] - reference.cam_K[c],
        ]
    parts += [line - old for line, old in zip(state.beam_l, reference.beam_l, strict=True)]
    for p, n in enumerate(reference.plane_n):
        along = float(n @ state.plane_n[p])
        tilt = basis_of(n).T @ state.plane_n[p] / along if along > 0 else np.full(2, np.inf)
        parts.append(np.append(tilt, state.plane_d[p] - reference.plane_d[p]))
    return np.concatenate(parts)


def _wanted(source: Source, prior: GtsamPrior) -> Held:
    """What the file must hold, from the calibration itself."""
    cell = source.cell
    cameras = {name: cell.cameras[name] for name in prior.cameras}
    part = Cell(
        cameras,
        {name: cell.lasers[name] for name in prior.lasers},
        {name: cell.planes[name] for name in prior.planes},
    )
    labels = tangent_labels(part)
    rows = [source.labels.index(label) for label in labels]
    return Held(
        poses={name: camera.T_base_camera for name, camera in cameras.items()},
        intrinsics={name: camera.intrinsics for name, camera in cameras.items()},
        image_size={name: camera.image_size for name, camera in cameras.items()},
        covariance=source.covariance[np.ix_(rows, rows)],
        labels=labels,
    )


def _held(prior: GtsamPrior) -> Held:
    """Content as GTSAM's accessors give it, the covariance turned back to our coordinates."""
    values = prior.values
    poses, lenses = {}, {}
    for name, (pose, lens) in zip(prior.cameras, prior.keys.cameras, strict=True):
        T = values.atPose3(pose)
        poses[name] = make_pose(T.rotation().matrix(), T.translation())
        lenses[name] = Intrinsics.from_vector(values.atCal3DS2(lens).vector())
    signs = _signs(prior.keys)
    labels = [f"{name}.{t}" for name in prior.cameras for t in CAMERA_TANGENT]
    labels += [f"{name}.{t}" for name in prior.lasers for t in BEAM_TANGENT]
    labels += [f"plane {name}.{t}" for name in prior.planes for t in PLANE_TANGENT]
    return Held(
        poses=poses,
        intrinsics=lenses,
        image_size=dict(zip(prior.cameras, prior.image_size, strict=True)),
        covariance=prior.covariance * np.outer(signs, signs),
        labels=tuple(labels),
    )
