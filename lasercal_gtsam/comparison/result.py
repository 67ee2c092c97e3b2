"""What a comparison says, as frozen data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.figures.error_map import Contour
from lasercal_gtsam.figures.places import PlaneAxes
from lasercal_gtsam.frozen import Array, FrozenData

Mask = npt.NDArray[np.bool_]
PartKind = Literal["camera", "lens", "laser", "plane"]


@dataclass(frozen=True)
class RowChange:
    """A row of the table in both, in its unit.

    ``sigma`` is that of the difference: 0 where both hold the row, NaN where it is unknown.
    """

    name: str
    unit: str
    a: float
    b: float
    difference: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """The difference in sigmas of the difference; NaN where there is no sigma."""
        return self.difference / self.sigma if self.sigma > 0 else float("nan")


@dataclass(frozen=True)
class Motion:
    """How far a part is turned and shifted, and one sigma of either along itself."""

    turn_deg: float
    turn_sigma_deg: float
    shift_mm: float
    shift_sigma_mm: float


@dataclass(frozen=True)
class PartChange:
    """How a part differs, all its coordinates together.

    Attributes
    ----------
    kind, name : ``camera`` is its pose in the base, ``lens`` its intrinsics
    distance : Mahalanobis distance of the difference: its length in sigmas, correlations included
    unknowns : coordinates that can differ by noise; 0 where both hold all of them
    chance : of so large a distance by noise alone (F distribution); NaN where it cannot be said
    corrected : the same for the largest of all parts that were looked at (Holm)
    turn_deg, turn_sigma_deg : how far it is turned, and one sigma of that; NaN for a lens
    shift_mm, shift_sigma_mm : how far it is shifted, and one sigma of that; NaN for a lens. Of a
        camera its centre; of a beam across itself where it passes the hand's origin; of a plane
        along its normal in the middle of its spots
    held : coordinates that both hold, at different values
    alone : the motion if only the parts that changed have changed: much sharper, as errors of a
        lens and of a pose make up for each other. Of parts that noise does not explain, where it
        explains all others; else None
    """

    kind: PartKind
    name: str
    distance: float
    unknowns: int
    chance: float
    corrected: float
    turn_deg: float
    turn_sigma_deg: float
    shift_mm: float
    shift_sigma_mm: float
    held: tuple[str, ...] = ()
    alone: Motion | None = None

    @property
    def label(self) -> str:
        """What it is, for a table."""
        return f"{'lens of camera' if self.kind == 'lens' else self.kind} {self.name!r}"


@dataclass(frozen=True, eq=False)
class PixelMap(FrozenData):
    """Where the two see the same base points: those that A has on a plane, over A's picture.

    Attributes
    ----------
    camera, plane, image_size : which
    uv : (K, 2) px where A sees the points
    difference_px : (K, 2) where B sees them, minus ``uv``; NaN where B does not see one
    expected_px : (K,) root mean squared length of the difference by noise; NaN where unknown
    near : (K,) points in the hull of the spots that the two have there (all where there are none)
    median_px, largest_px, expected_median_px : lengths over ``near``
    outside_px : largest outside the hull; None where nothing is
    """

    camera: str
    plane: str
    image_size: tuple[int, int]
    uv: Array
    difference_px: Array
    expected_px: Array
    near: Mask
    median_px: float
    largest_px: float
    expected_median_px: float
    outside_px: float | None


@dataclass(frozen=True, eq=False)
class PlaneMap(FrozenData):
    """How far apart the two locate the same pixel on a plane (`Calibration.locate`), mm.

    Attributes
    ----------
    plane, camera, axes : which, and drawing axes on A's plane
    x_mm, y_mm : (nx,), (ny,) grid nodes
    difference_mm : (ny, nx) distance between the located points; NaN where one is not
    expected_mm : (ny, nx) root mean square of it by noise; NaN where unknown
    near : (ny, nx) nodes in the hull of A's spots (in its view where there are none)
    contours : lines of equal difference
    hull_mm, view_mm, spots_mm : hull, view and spots of A
    median_mm, largest_mm, largest_at_mm, expected_median_mm : over ``near``
    outside_mm : largest outside the hull, on the map; None where nothing is
    """

    plane: str
    camera: str
    axes: PlaneAxes
    x_mm: Array
    y_mm: Array
    difference_mm: Array
    expected_mm: Array
    near: Mask
    contours: tuple[Contour, ...]
    hull_mm: Array
    view_mm: Array
    spots_mm: Array
    median_mm: float
    largest_mm: float
    largest_at_mm: Array
    expected_median_mm: float
    outside_mm: float | None


@dataclass(frozen=True)
class Change:
    """Something of the inputs that differs: its value in A and in B, "" where it has none."""

    name: str
    a: str
    b: str


@dataclass(frozen=True)
class InputsChange:
    """What differs in the inputs.

    Attributes
    ----------
    spots_a, spots_b : how many spots each has, left-out ones too
    shared : measurements (pixel, hand pose, camera, laser, plane) that both have
    only_a, only_b : ids of the spots that one alone has
    altered : ids that both have with other values (other spots under the same name, or the same
        picture looked at anew)
    same_pose : of the spots that one alone has, how many have the hand pose of one that the other
        alone has
    rejected : ids of shared spots that one left out and the other used
    options : options that differ
    files : files that differ, by SHA-256
    made : version and time of making, where they differ
    """

    spots_a: int
    spots_b: int
    shared: int
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    altered: tuple[str, ...]
    same_pose: int
    rejected: tuple[str, ...]
    options: tuple[Change, ...]
    files: tuple[Change, ...]
    made: tuple[Change, ...]


@dataclass(frozen=True)
class Comparison:
    """Two calibrations beside each other; differences are B minus A.

    Attributes
    ----------
    verdict : ``same`` within noise, ``different``, ``identical``, or ``unknown`` (no sigmas, or
        nothing in common)
    words : the conclusion, one sentence
    next_action : what to do
    basis : what the sigmas of the differences rest on: independent spots, or which are shared
    distance, unknowns, chance : of all parts together, as in `PartChange`
    rows, parts : every row of the table, every part
    pixel_maps, plane_maps : by camera and plane
    inputs : what differs in what the two were made from
    only_a, only_b : parts that one alone has
    notes : what to know besides
    """

    verdict: Literal["same", "different", "identical", "unknown"]
    words: str
    next_action: str
    basis: str
    distance: float
    unknowns: int
    chance: float
    rows: tuple[RowChange, ...]
    parts: tuple[PartChange, ...]
    pixel_maps: tuple[PixelMap, ...]
    plane_maps: tuple[PlaneMap, ...]
    inputs: InputsChange
    only_a: tuple[str, ...] = ()
    only_b: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())
