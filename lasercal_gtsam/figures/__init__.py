"""What the figures show, as frozen arrays: for the report, for plots, for anything else.

Pure functions of a `Calibration`; nothing here draws.

- `residuals`: over the picture, and their histogram against the expected one;
- `coverage`: of each picture and each plane;
- `error_map`: expected error on a plane in millimetres, and the same from split data;
- `correlation`: of the rows of the table;
- `scene`: the cell in space;
- `places`, `contours`, `spots`: what these share.
"""

from lasercal_gtsam.figures.correlation import Correlation, correlation
from lasercal_gtsam.figures.coverage import (
    ImageCoverage,
    PlaneCoverage,
    image_coverages,
    plane_coverages,
)
from lasercal_gtsam.figures.error_map import ErrorMap, error_map, error_maps
from lasercal_gtsam.figures.residuals import (
    ResidualField,
    ResidualHistogram,
    residual_fields,
    residual_histograms,
)
from lasercal_gtsam.figures.scene import Scene, scene

__all__ = [
    "Correlation",
    "ErrorMap",
    "ImageCoverage",
    "PlaneCoverage",
    "ResidualField",
    "ResidualHistogram",
    "Scene",
    "correlation",
    "error_map",
    "error_maps",
    "image_coverages",
    "plane_coverages",
    "residual_fields",
    "residual_histograms",
    "scene",
]
