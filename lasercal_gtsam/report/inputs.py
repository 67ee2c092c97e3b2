"""What a calibration was made from and with, so that it can be made again."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from lasercal_gtsam.io.calibration_file import inputs_digest, package_version
from lasercal_gtsam.io.plain import option_text
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.report.material import Material

_PACKAGES = ("lasercal-gtsam", "gtsam", "numpy", "scipy", "numba", "opencv-python-headless")
_FILE, _REPORT = "calibration.json", "report.html"
_OPTIONS = {
    "sigma_px": "pixel sigma of spots without one of their own; none: from the residuals",
    "hand_sigma_m": "robot noise of a hand position, metres a coordinate",
    "hand_sigma_rad": "robot noise of a hand orientation, radians an axis",
    "estimate_noise": "levels of the robot's noise that are found from the residuals",
    "robust": "what is done about outliers",
    "distortion": "distortion terms that are estimated",
    "known": "held at these values",
    "fixed": "held at the start's values",
    "priors": "Gaussian priors on rows of the table: mean, sigma",
    "max_iterations": "limit of one solve",
    "seed": "of whatever draws numbers",
}


def inputs_section(material: Material) -> dict[str, Any]:
    """Files and hashes, options, versions, and the commands that repeat the run."""
    calibration, origin = material.calibration, material.origin
    options = calibration.inputs.options
    return {
        "heading": "Inputs",
        "words": [
            "The same spots and options give the same numbers, to the last digit, with the same "
            "versions on the same kind of machine."
        ],
        "missing": None,
        "files": [{"name": name, "sha256": digest} for name, digest in origin.files.items()],
        "calibration": {"name": origin.file, "sha256": origin.sha256} if origin.file else None,
        "inputs_sha256": inputs_digest(calibration),
        "calibrated": origin.created or None,
        "made_with": origin.version or None,
        "versions": {
            "python": platform.python_version(),
            "platform": platform.platform(terse=True),
            **{name: package_version(name) for name in _PACKAGES},
        },
        "options": [
            {
                "name": f.name,
                "value": option_text(getattr(options, f.name)),
                "words": _OPTIONS.get(f.name, ""),
            }
            for f in fields(options)
        ],
        "commands": list(_commands(material)),
        "n_spots": len(calibration.inputs.observations),
    }


def _commands(material: Material) -> Iterator[dict[str, str]]:
    origin, options = material.origin, material.calibration.inputs.options
    file = origin.file or _FILE
    # what a capture holds is named first in its provenance
    capture = next((name for name in origin.files if name.endswith((".yaml", ".yml"))), None)
    line = _calibrate(options, capture, file) if capture else None
    if line:
        yield {"words": "Calibrate the capture again.", "command": line}
    if len(material.calibration.inputs.observations):
        start = ", initial=old.initial" if options.fixed else ""  # held at the start's values
        yield {
            "words": "Calibrate again from the spots and options in the calibration itself, in "
            "Python.",
            "command": "import lasercal_gtsam as lc\n"
            f"old = lc.load_calibration({file!r})\n"
            f"again = lc.calibrate(old.inputs.observations{start}, options=old.inputs.options)",
        }
    words = shlex.join(["lasercal", "report", file, "-o", _REPORT])
    yield {"words": "Make this report again.", "command": words}


def _calibrate(options: CalibrationOptions, capture: str, file: str) -> str | None:
    """The command that gives these options; None where the command line has no word for one.

    Noise and known values that the capture states need not be repeated, and do no harm.
    """
    default = CalibrationOptions()
    if options.priors or (options.max_iterations, options.seed) != (
        default.max_iterations,
        default.seed,
    ):
        return None
    words = ["lasercal", "calibrate", capture]
    if options.estimate_noise:
        words.append("--estimate-noise")
    if options.distortion != default.distortion:
        terms = options.distortion
        words += ["--distortion", terms if isinstance(terms, str) else ",".join(terms)]
    if options.robust != default.robust:
        words += ["--robust", options.robust]
    if options.sigma_px is not None:
        words += ["--sigma-px", f"{options.sigma_px!r}"]
    for name, value in options.known.items():
        numbers = value if isinstance(value, tuple | list) else (value,)
        words += ["--known", f"{name}={','.join(f'{x!r}' for x in numbers)}"]
    for name in options.fixed:
        words += ["--fixed", name]
    if options.fixed:  # what is held there is what was held
        words += ["--initial", file]
    return shlex.join([*words, "-o", file])
