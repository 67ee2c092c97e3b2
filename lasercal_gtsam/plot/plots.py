"""What ``calibration.plot`` offers: one figure a method, each on the axes that it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures import (
    correlation,
    error_map,
    image_coverages,
    plane_coverages,
    residual_fields,
    scene,
)
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.plot import style
from lasercal_gtsam.plot.picture import draw_image_coverage, draw_residuals
from lasercal_gtsam.plot.plane import draw_error_map, draw_plane_coverage
from lasercal_gtsam.plot.rows import draw_correlation
from lasercal_gtsam.plot.space import draw_scene
from lasercal_gtsam.prediction import only

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

    from lasercal_gtsam.calibration import Calibration


@dataclass(frozen=True, eq=False)
class Plots:
    """Figures of a calibration, drawn with Matplotlib (extra ``report``).

    Every method draws on ``ax``, or on the axes of a new figure, and returns them: change what you
    like, then ``ax.figure.savefig(...)``. Names may be left out where the cell has only one. All
    raise `DataError` where Matplotlib is missing, a name is unknown or left out among several, or
    there is nothing to draw.
    """

    calibration: Calibration

    def residuals(self, camera: str | None = None, *, ax: Axes | None = None) -> Axes:
        """Residuals over a camera's picture as arrows, predicted minus seen, their scale stated."""
        fields = {one.camera: one for one in residual_fields(self.calibration) if one.total}
        field = fields[_one(fields, camera, "camera")]
        ax = style.flat_axes(ax, *field.image_size)
        draw_residuals(ax, field, self.calibration.inputs.observations)
        return ax

    def coverage(
        self, camera: str | None = None, *, plane: str | None = None, ax: Axes | None = None
    ) -> Axes:
        """Where the spots lie in a camera's picture; with ``plane``: where on that plane."""
        if plane is not None:
            if camera is not None:
                raise DataError("coverage: give a camera (its picture) or a plane, not both")
            planes = {one.plane: one for one in plane_coverages(self.calibration)}
            found = planes[only(tuple(planes), plane, "plane")]
            if not found.total:
                raise DataError(f"coverage: no spot of plane {plane!r} was used")
            ax = style.flat_axes(ax, *_extent([v.outline_mm for v in found.views], found.xy_mm))
            draw_plane_coverage(ax, found)
            return ax
        images = {one.camera: one for one in image_coverages(self.calibration)}
        image = images[_one(images, camera, "camera")]
        ax = style.flat_axes(ax, *image.image_size)
        draw_image_coverage(ax, image, self.calibration.inputs.observations)
        return ax

    def error_map(
        self, plane: str | None = None, camera: str | None = None, *, ax: Axes | None = None
    ) -> Axes:
        """Expected error (mm) of points located on a plane, with labelled contours."""
        found = error_map(self.calibration, plane, camera)
        ax = style.flat_axes(
            ax, 1.25 * (found.x_mm[-1] - found.x_mm[0]), found.y_mm[-1] - found.y_mm[0]
        )
        draw_error_map(ax, found)
        return ax

    def correlation(self, *, ax: Axes | None = None) -> Axes:
        """Correlation matrix of the rows of the table."""
        found = correlation(self.calibration)
        if not found.names:
            raise DataError("correlation: there are no sigmas, and so no correlations")
        ax = style.new_figure(6.0, 5.4).subplots() if ax is None else ax
        draw_correlation(ax, found)
        return ax

    def cell(self, *, ax: Axes3D | None = None) -> Axes3D:
        """The cell in space: base, camera, beams, planes, spots, enlarged uncertainties."""
        ax = style.space_axes(ax)
        draw_scene(ax, scene(self.calibration))
        return ax


def _one(found: Mapping[str, object], given: str | None, kind: str) -> str:
    """The name given, or the only one; DataError where there are no spots at all."""
    if not found:
        raise DataError("the calibration holds no spots that were used: there is nothing to draw")
    return only(tuple(found), given, kind)


def _extent(outlines: list[Array], points: Array) -> tuple[float, float]:
    low, high = points.min(axis=0), points.max(axis=0)
    for outline in outlines:
        if len(outline):
            low, high = low.clip(max=outline.min(axis=0)), high.clip(min=outline.max(axis=0))
    across, down = (high - low).tolist()
    return max(across, 1e-9), down
