"""Calibrate a robot cell from laser spots: camera, hand-eye, beam and planes, with sigmas.

``import lasercal_gtsam as lc``: the public names below are loaded on first use, so that importing
the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_EXPORTS = {
    "Beam": "cell",
    "Calibration": "calibration",
    "CalibrationOptions": "options",
    "Camera": "cell",
    "Cell": "cell",
    "Comparison": "comparison",
    "DataError": "errors",
    "DegenerateError": "errors",
    "DetectionError": "errors",
    "IncrementalCalibrator": "incremental",
    "Intrinsics": "cell",
    "LasercalError": "errors",
    "Observations": "observations",
    "Parameter": "calibration",
    "Plane": "cell",
    "SigmaCheck": "sigma_check.result",
    "SolveError": "errors",
    "Update": "incremental",
    "Verdict": "opinions",
    "adjusted_hand_poses": "hand_noise.poses",
    "calibrate": "api",
    "compare": "comparison",
    "export": "formats.export",
    "hand_pose_graph": "hand_noise.explicit",
    "intervals": "confidence",
    "judge": "opinions",
    "check_sigma": "sigma_check.study",
    "load_calibration": "io.calibration_file",
    "load_capture": "io.capture",
    "load_gtsam": "formats.gtsam_graph",
    "load_intrinsics": "formats.intrinsics",
    "project": "projection",
    "spot_on_beam": "projection",
    "spot_on_ray": "projection",
    "spot_triangulated": "projection",
    "to_gtsam": "formats.gtsam_graph",
}

_PACKAGES = ("study",)

__all__ = [
    "Beam",
    "Calibration",
    "CalibrationOptions",
    "Camera",
    "Cell",
    "Comparison",
    "DataError",
    "DegenerateError",
    "DetectionError",
    "IncrementalCalibrator",
    "Intrinsics",
    "LasercalError",
    "Observations",
    "Parameter",
    "Plane",
    "SigmaCheck",
    "SolveError",
    "Update",
    "Verdict",
    "__version__",
    "adjusted_hand_poses",
    "calibrate",
    "check_sigma",
    "compare",
    "export",
    "hand_pose_graph",
    "intervals",
    "judge",
    "load_calibration",
    "load_capture",
    "load_gtsam",
    "load_intrinsics",
    "project",
    "spot_on_beam",
    "spot_on_ray",
    "spot_triangulated",
    "to_gtsam",
]

if TYPE_CHECKING:
    from lasercal_gtsam import study as study
    from lasercal_gtsam.api import calibrate
    from lasercal_gtsam.calibration import Calibration, Parameter
    from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
    from lasercal_gtsam.comparison import Comparison, compare
    from lasercal_gtsam.confidence import intervals
    from lasercal_gtsam.errors import (
        DataError,
        DegenerateError,
        DetectionError,
        LasercalError,
        SolveError,
    )
    from lasercal_gtsam.formats.export import export
    from lasercal_gtsam.formats.gtsam_graph import load_gtsam, to_gtsam
    from lasercal_gtsam.formats.intrinsics import load_intrinsics
    from lasercal_gtsam.hand_noise.explicit import hand_pose_graph
    from lasercal_gtsam.hand_noise.poses import adjusted_hand_poses
    from lasercal_gtsam.incremental import IncrementalCalibrator, Update
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.io.capture import load_capture
    from lasercal_gtsam.observations import Observations
    from lasercal_gtsam.opinions import Verdict, judge
    from lasercal_gtsam.options import CalibrationOptions
    from lasercal_gtsam.projection import (
        project,
        spot_on_beam,
        spot_on_ray,
        spot_triangulated,
    )
    from lasercal_gtsam.sigma_check.result import SigmaCheck
    from lasercal_gtsam.sigma_check.study import check_sigma


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"{__name__}.{name}")
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
