"""``calibration.json`` as checked data: its keys and shapes, and the objects built from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    model_validator,
)

from lasercal_gtsam.calibration import (
    Calibration,
    Fit,
    Inputs,
    NoiseLevel,
    Observability,
    Parameter,
    SpotResults,
    WeakDirection,
)
from lasercal_gtsam.cell import ROTATION_TOLERANCE, Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.conventions import rotations_from_columns
from lasercal_gtsam.io.json_numbers import (
    INFINITIES,
    Matrix,
    Matrix44,
    Number,
    Ordinary,
    Rows2,
    Rows4,
    Rows16,
    Sigma,
    Size,
    Vector2,
    Vector3,
    Vector4,
    Weight,
    may_be_covariance,
)
from lasercal_gtsam.io.wording import did_you_mean
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.rotations import make_pose

# Matrix and quaternion of one pose are the same rotation written twice; the matrix need not be
# orthonormal to the last digit, the quaternion's always is.
POSE_AGREEMENT = 10 * ROTATION_TOLERANCE

T = TypeVar("T")


class _Part(BaseModel):
    """Keys that a later version adds are ignored; missing and wrong ones are errors."""

    model_config = ConfigDict(extra="ignore", strict=True, arbitrary_types_allowed=True)


class PoseModel(_Part):
    """A transform; the matrix is exact, the other two are for readers."""

    translation_m: Vector3
    quat_wxyz: Vector4
    matrix: Matrix44 | None = None

    @model_validator(mode="after")
    def _agree(self) -> PoseModel:
        if self.matrix is not None:
            difference = float(np.abs(self.matrix - self._from_quaternion()).max())
            if not difference <= POSE_AGREEMENT:
                raise ValueError(
                    "translation_m and quat_wxyz are another pose than matrix (elements differ by "
                    f"{difference:.2g}); after editing by hand remove matrix"
                )
        return self

    def _from_quaternion(self) -> Array:
        try:
            R = rotations_from_columns("quat_wxyz", self.quat_wxyz[None])[0]
        except DataError as error:
            raise ValueError(f"quat_wxyz: {error}") from None
        return make_pose(R, self.translation_m)

    def build(self) -> Array:
        """The 4x4 matrix."""
        return self._from_quaternion() if self.matrix is None else self.matrix


class IntrinsicsModel(_Part):
    """Intrinsics, all nine named."""

    fu: Ordinary
    fv: Ordinary
    skew: Ordinary
    u0: Ordinary
    v0: Ordinary
    k1: Ordinary
    k2: Ordinary
    p1: Ordinary
    p2: Ordinary


class CameraModel(_Part):
    """One camera."""

    image_size: Size
    intrinsics: IntrinsicsModel
    T_base_camera: PoseModel

    def build(self) -> Camera:
        """The camera."""
        intrinsics = Intrinsics(**self.intrinsics.model_dump())
        width, height = self.image_size
        return Camera(intrinsics, self.T_base_camera.build(), (width, height))


class LaserModel(_Part):
    """One beam."""

    direction_hand: Vector3
    point_hand_m: Vector3

    def build(self) -> Beam:
        """The beam."""
        return Beam(self.direction_hand, self.point_hand_m)


class PlaneModel(_Part):
    """One plane."""

    normal_base: Vector3
    distance_m: Ordinary

    def build(self) -> Plane:
        """The plane."""
        return Plane(self.normal_base, self.distance_m)


class CellModel(_Part):
    """A cell by names."""

    cameras: dict[str, CameraModel]
    lasers: dict[str, LaserModel]
    planes: dict[str, PlaneModel]

    def build_cell(self, where: str, problems: list[str]) -> Cell | None:
        """The cell, or None and what is wrong with its parts (named after ``where``)."""
        cameras = {
            name: _built(f"{where}cameras.{name}", m.build, problems)
            for name, m in self.cameras.items()
        }
        lasers = {
            name: _built(f"{where}lasers.{name}", m.build, problems)
            for name, m in self.lasers.items()
        }
        planes = {
            name: _built(f"{where}planes.{name}", m.build, problems)
            for name, m in self.planes.items()
        }
        if problems:
            return None
        return Cell(
            {name: part for name, part in cameras.items() if part is not None},
            {name: part for name, part in lasers.items() if part is not None},
            {name: part for name, part in planes.items() if part is not None},
        )


class ParameterModel(_Part):
    """One row of the table."""

    name: str
    initial: Number
    refined: Number
    sigma: Sigma
    unit: str


class CovarianceModel(_Part):
    """The joint covariance."""

    labels: list[str]
    matrix: Matrix


class NoiseLevelModel(_Part):
    """A noise level that was estimated."""

    name: str
    value: Number
    standard_error: Number
    low: Number
    high: Number


class FitModel(_Part):
    """How the fit went."""

    rms_px: Ordinary
    sigma0: Ordinary
    dof: Ordinary
    iterations: int
    converged: bool
    status: str
    n_spots: int
    n_rejected: int
    noise: list[NoiseLevelModel] = []  # unknown to older files

    def build(self) -> Fit:
        """The account of the fit."""
        noise = tuple(NoiseLevel(**level.model_dump()) for level in self.noise)
        return Fit(**{**self.model_dump(exclude={"noise"}), "noise": noise})


class SpotModel(_Part):
    """The account of one spot."""

    id: str
    plane: str
    camera: str
    laser: str
    residual_px: Vector2
    weight: Weight
    rejected: str | None
    leverage: Number = math.nan  # unknown to older files


class WeakModel(_Part):
    """One weak direction."""

    strength: Number
    words: str


class ObservabilityModel(_Part):
    """What the data hardly determine."""

    weak: list[WeakModel]
    held: list[str]
    notes: list[str]


class ObservationsModel(_Part):
    """Observations as columns."""

    id: list[str]
    plane: list[str]
    camera: list[str]
    laser: list[str]
    image_size: dict[str, Size]
    uv: Rows2
    cov_uv: Rows4 | None
    T_base_hand: Rows16
    stop: list[str] | None = None  # unknown to older files

    def build(self) -> Observations:
        """The observations."""
        count = len(self.uv)
        if len(self.T_base_hand) != count:
            raise DataError(f"{count} pixels uv but {len(self.T_base_hand)} poses T_base_hand")
        cov = np.full((count, 4), np.nan) if self.cov_uv is None else self.cov_uv
        if len(cov) != count:
            raise DataError(f"{count} pixels uv but {len(cov)} covariances cov_uv")
        return Observations(
            uv=self.uv,
            cov_uv=cov.reshape(-1, 2, 2),
            T_base_hand=self.T_base_hand.reshape(-1, 4, 4),
            camera=np.array(self.camera, dtype=np.str_),
            laser=np.array(self.laser, dtype=np.str_),
            plane=np.array(self.plane, dtype=np.str_),
            id=np.array(self.id, dtype=np.str_),
            image_size={name: (size[0], size[1]) for name, size in self.image_size.items()},
            stop=None if self.stop is None else np.array(self.stop, dtype=np.str_),
        )


class InputsModel(_Part):
    """What went in."""

    observations: ObservationsModel
    options: dict[str, Any]

    def build_options(self) -> CalibrationOptions:
        """The options; later versions may have more of them, which this one cannot obey."""
        allowed = [f.name for f in fields(CalibrationOptions)]
        unknown = [name for name in self.options if name not in allowed]
        if unknown:
            raise DataError(
                *(f"unknown option {name!r}{did_you_mean(name, allowed)}" for name in unknown)
            )
        try:
            return CalibrationOptions(**{name: _tuples(v) for name, v in self.options.items()})
        except (TypeError, AttributeError) as error:  # a list or a mapping that is none
            raise DataError(f"an option is of a wrong kind: {error}") from None


class CalibrationModel(CellModel):
    """The whole file."""

    initial: CellModel
    parameters: list[ParameterModel]
    covariance: CovarianceModel
    fit: FitModel
    spots: list[SpotModel]
    observability: ObservabilityModel
    inputs: InputsModel

    def build(self) -> Calibration:
        """The calibration; `DataError` names all parts that are wrong."""
        problems: list[str] = []
        cell = self.build_cell("", problems)
        initial = self.initial.build_cell("initial.", problems)
        observations = _built("inputs.observations", self.inputs.observations.build, problems)
        options = _built("inputs.options", self.inputs.build_options, problems)
        if cell is not None and initial is not None and observations is not None:
            problems += self._contradictions(cell, initial, observations)
        if cell is None or initial is None or observations is None or options is None or problems:
            raise DataError(*problems)
        return Calibration(
            cell=cell,
            initial=initial,
            parameters=tuple(Parameter(**row.model_dump()) for row in self.parameters),
            covariance=self.covariance.matrix,
            labels=tuple(self.covariance.labels),
            fit=self.fit.build(),
            spots=self._spots(),
            observability=Observability(
                tuple(WeakDirection(w.strength, w.words) for w in self.observability.weak),
                tuple(self.observability.held),
                tuple(self.observability.notes),
            ),
            inputs=Inputs(observations, options),
        )

    def _contradictions(
        self, cell: Cell, initial: Cell, observations: Observations
    ) -> Iterator[str]:
        """What no part of the file can show by itself."""
        for kind in ("cameras", "lasers", "planes"):
            apart = set(getattr(cell, kind)) ^ set(getattr(initial, kind))
            if apart:
                named = ", ".join(map(repr, sorted(apart)))
                yield f"{kind}, initial.{kind}: {named} is in one of them only"
        labels = self.covariance.labels
        known = set(tangent_labels(cell))
        odd = [label for label in labels if label not in known]
        if odd or len(set(labels)) < len(labels):
            found = f"{odd[0]!r:.60}" if odd else "a label twice"
            yield f"covariance.labels: expected those of the cell's parts, got {found}"
        if not may_be_covariance(self.covariance.matrix):
            yield (
                "covariance.matrix: expected a symmetric matrix without a direction of negative "
                "variance"
            )
        if [spot.id for spot in self.spots] != observations.id.tolist():
            yield "spots, inputs.observations: expected the same ids in the same order"
            return
        used = np.array([spot.rejected is None for spot in self.spots], dtype=np.bool_)
        for kind in ("camera", "laser", "plane"):
            there = set(getattr(observations, kind)[used].tolist())
            if lost := sorted(there - set(getattr(cell, f"{kind}s"))):
                yield f"inputs.observations.{kind}: {lost[0]!r:.60} is used, but not in the cell"

    def _spots(self) -> SpotResults:
        return SpotResults(
            id=np.array([s.id for s in self.spots], dtype=np.str_),
            plane=np.array([s.plane for s in self.spots], dtype=np.str_),
            camera=np.array([s.camera for s in self.spots], dtype=np.str_),
            laser=np.array([s.laser for s in self.spots], dtype=np.str_),
            residual_px=np.array([s.residual_px for s in self.spots]).reshape(-1, 2),
            weight=np.array([s.weight for s in self.spots]),
            rejected=tuple(s.rejected for s in self.spots),
            leverage=np.array([s.leverage for s in self.spots]),
        )


def _built(where: str, build: Callable[[], T], problems: list[str]) -> T | None:
    try:
        return build()
    except DataError as error:
        problems += [f"{where}: {text}" for text in error.problems]
        return None


def _tuples(value: Any) -> Any:
    """Lists as the tuples they were before JSON, infinities as numbers."""
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return INFINITIES.get(value, value) if isinstance(value, str) else value
