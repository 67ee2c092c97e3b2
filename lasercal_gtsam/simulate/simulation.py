"""Observations of a known cell: exact or noisy, planned so that every spot is in view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.observations import Names, Observations, natural_key
from lasercal_gtsam.projection import project
from lasercal_gtsam.simulate.motions import MotionDesign, design_named, plan_motions
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.presets import preset_named
from lasercal_gtsam.simulate.streams import CELL, MOTIONS, NOISE, stream

Index = npt.NDArray[np.int64]

_MAX_REPEATS = 100


@dataclass(frozen=True, eq=False)
class Simulation(FrozenData):
    """A capture of a known cell.

    Attributes
    ----------
    truth : the cell that made the observations
    observations : what a user has: commanded hand poses and (noisy) pixels, without covariances
    noise : what was added to them
    known : what may be held fixed because the data cannot give it, in the form of
        ``CalibrationOptions.known``: principal point (px) and skew (px) where there is one plane
    T_base_hand_actual : (N, 4, 4), metres; where the hand really was, commanded pose plus noise
    group : (N,) labels; shots with the same label share plane and hand rotation. Extra information
        for tests: a calibration finds the groups from the poses
    repeated : number of shots that were taken again because noise moved the spot out of the picture
    preset, seed : where it came from
    """

    truth: Cell
    observations: Observations
    noise: Noise
    known: Mapping[str, Any]
    T_base_hand_actual: Array
    group: Index
    repeated: int
    preset: str
    seed: int

    def __post_init__(self) -> None:
        count = len(self.observations)
        set_array(self, "T_base_hand_actual", self.T_base_hand_actual, (count, 4, 4))
        group = np.array(self.group, dtype=np.int64)
        if group.shape != (count,):
            raise DataError(f"Simulation.group: expected {count} labels, got shape {group.shape}")
        group.flags.writeable = False
        object.__setattr__(self, "group", group)
        object.__setattr__(self, "known", dict(self.known))

    @property
    def uv_true(self) -> Array:
        """(N, 2) pixels where the beam's axis shows: the real hand, without pixel noise."""
        seen = self.observations
        return project(
            self.truth,
            self.T_base_hand_actual,
            plane=seen.plane.tolist(),
            camera=seen.camera.tolist(),
            laser=seen.laser.tolist(),
        )


def simulate(
    preset: str = "paper",
    seed: int = 0,
    noise: Noise | None = None,
    *,
    groups: int | None = None,
    shots: int | None = None,
    design: MotionDesign | str | None = None,
) -> Simulation:
    """Simulate one of the cells in `PRESETS`.

    The same arguments give the same numbers to the last bit, whatever was simulated before. Cell
    and motions depend on preset and seed only, so that noise levels can be compared pose by pose.

    Parameters
    ----------
    preset : a name out of `PRESETS`
    seed : any integer >= 0
    noise : what is added to pixels and hand poses; None: exact pixels. ``PRESETS[name].noise`` is
        the noise that goes with the preset in the paper
    groups, shots : hand rotations per plane and poses per rotation, instead of the preset's
    design : a name out of `DESIGNS` or a `MotionDesign`, instead of the preset's

    Raises
    ------
    DataError
        Unknown preset or design, or no motions found that keep the spot in view.
    """
    chosen = preset_named(preset)
    made = simulate_cell(
        chosen.cell(stream(seed, CELL)),
        groups=chosen.groups if groups is None else groups,
        shots=chosen.shots if shots is None else shots,
        seed=seed,
        noise=noise,
        design=chosen.design if design is None else design,
    )
    return replace(made, preset=chosen.name)


def simulate_cell(
    cell: Cell,
    planes: Sequence[str] | None = None,
    groups: int | Mapping[str, int] = 3,
    shots: int = 10,
    *,
    seed: int = 0,
    noise: Noise | None = None,
    design: MotionDesign | str = "paper",
    camera: str | None = None,
    laser: str | None = None,
    prefix: str = "s",
) -> Simulation:
    """Simulate any cell: one camera, one laser, some of its planes.

    Captures of several cameras or lasers are made one after the other, each with its own prefix,
    and joined with ``a.observations + b.observations``.

    Parameters
    ----------
    cell : the truth
    planes : names of the planes to use; None: all
    groups : hand rotations per plane, or a number for every plane by name
    shots : poses per rotation; 1 gives arbitrary poses in no groups
    seed, noise, design : as in `simulate`
    camera, laser : names; may be left out where the cell has one
    prefix : start of the spots' labels

    Raises
    ------
    DataError
        Unknown names, or no motions found that keep the spot in view.
    """
    camera = _only(cell.cameras, camera, "camera")
    laser = _only(cell.lasers, laser, "laser")
    names = sorted(cell.planes, key=natural_key) if planes is None else list(planes)
    counts = _checked_counts(cell, names, groups, shots)
    if isinstance(design, str):
        design = design_named(design)
    rng = stream(seed, MOTIONS)
    view = cell.cameras[camera], cell.lasers[laser]
    planned = [
        plan_motions(*view, cell.planes[name], count, shots, design, rng)
        for name, count in zip(names, counts, strict=True)
    ]
    T_base_hand = np.concatenate(planned).reshape(-1, 4, 4)
    plane = np.repeat(names, np.array(counts) * shots)
    noise = Noise() if noise is None else noise
    seen = _take_shots(cell, T_base_hand, plane, camera, laser, noise, stream(seed, NOISE))
    observations = Observations.from_arrays(
        seen.uv,
        T_base_hand,
        plane=plane.tolist(),
        image_size=cell.cameras[camera].image_size,
        camera=camera,
        laser=laser,
        id=_labels(prefix, len(plane)),
    )
    return Simulation(
        truth=cell,
        observations=observations,
        noise=noise,
        known=_known(cell, names, camera),
        T_base_hand_actual=seen.T_base_hand_actual,
        group=np.repeat(np.arange(sum(counts)), shots),
        repeated=seen.repeated,
        preset="",
        seed=seed,
    )


class _Shots(NamedTuple):
    uv: Array
    T_base_hand_actual: Array
    repeated: int


def _take_shots(
    cell: Cell,
    T_base_hand: Array,
    plane: Names,
    camera: str,
    laser: str,
    noise: Noise,
    rng: np.random.Generator,
) -> _Shots:
    """Move the hand, look at the spot, add the pixel noise (method note 10.2).

    A shot whose spot leaves the picture is taken again with new noise, as an operator would; a
    motion plan keeps the spots away from the edge, so this is rare (it is counted) unless the noise
    is large.
    """
    width, height = cell.cameras[camera].image_size
    uv, actual = np.empty((len(plane), 2)), np.array(T_base_hand)
    rows, repeated = np.arange(len(plane)), 0
    for _ in range(_MAX_REPEATS):
        actual[rows] = noise.moved_hands(T_base_hand[rows], rng)
        seen = project(cell, actual[rows], plane=plane[rows].tolist(), camera=camera, laser=laser)
        uv[rows] = seen + noise.pixel_px * rng.standard_normal(seen.shape)
        inside = np.all((uv[rows] >= -0.5) & (uv[rows] <= (width - 0.5, height - 0.5)), axis=-1)
        rows = rows[~inside]
        if len(rows) == 0:
            return _Shots(uv, actual, repeated)
        repeated += len(rows)
    raise DataError(
        f"simulate: after {_MAX_REPEATS} tries the noise still moves the spot of {len(rows)} shots "
        f"out of the {width} x {height} picture; give less noise than {noise}"
    )


def _known(cell: Cell, planes: Sequence[str], camera: str) -> dict[str, Any]:
    """What one plane cannot determine (paper, section 3.3)."""
    if len(set(planes)) > 1:
        return {}
    intrinsics = cell.cameras[camera].intrinsics
    return {"principal_point": (intrinsics.u0, intrinsics.v0), "skew": intrinsics.skew}


def _labels(prefix: str, count: int) -> list[str]:
    """Labels that sort in order; with a letter in front no spreadsheet takes them for numbers."""
    digits = max(3, len(str(count)))
    return [f"{prefix}{k + 1:0{digits}d}" for k in range(count)]


def _only(parts: Mapping[str, Any], name: str | None, kind: str) -> str:
    if name is None and len(parts) == 1:
        return next(iter(parts))
    if name not in parts:
        raise DataError(f"simulate_cell: {kind} {name!r}; the cell has {sorted(parts)}, name one")
    return str(name)


def _checked_counts(
    cell: Cell, planes: Sequence[str], groups: int | Mapping[str, int], shots: int
) -> list[int]:
    """Number of groups for each of the planes, or a `DataError` with all that is wrong."""
    problems = []
    unknown = [name for name in planes if name not in cell.planes]
    if unknown:
        problems.append(f"plane {unknown[0]!r} is not in the cell, which has {sorted(cell.planes)}")
    if not planes:
        problems.append("no plane to put spots on")
    if len(set(planes)) != len(planes):
        problems.append(f"a plane is named twice: {list(planes)}")
    counts = groups if isinstance(groups, Mapping) else dict.fromkeys(planes, groups)
    for name in planes:
        if name not in counts:
            problems.append(f"no number of groups for plane {name!r}")
        elif not _is_count(counts[name]):
            problems.append(
                f"groups on plane {name!r}: expected an integer >= 1, got {counts[name]!r}"
            )
    if not _is_count(shots):
        problems.append(f"shots: expected an integer >= 1, got {shots!r}")
    if problems:
        raise DataError(*(f"simulate_cell: {p}" for p in problems))
    return [int(counts[name]) for name in planes]


def _is_count(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= 1
