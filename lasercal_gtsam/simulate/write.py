"""A simulation as a capture on disk, with the truth beside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.simulation import Simulation
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

if TYPE_CHECKING:
    from lasercal_gtsam.simulate.pictures import PictureOptions

TRUTH_FILE = "truth.json"
TRUTH_FORMAT = "lasercal-truth"
_ON, _OFF = "images/{id}.png", "images/{id}_off.png"


def write_simulation(
    folder: str | Path,
    simulation: Simulation,
    *,
    rotation: str = "quat_wxyz",
    transform: Literal["T_base_hand", "T_hand_base"] = "T_base_hand",
    length: Literal["mm", "m"] = "mm",
    spots: bool = True,
    pictures: PictureOptions | None = None,
    state_noise: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a capture that `load_capture` reads back, and ``truth.json`` beside it.

    The folder appears whole or stays empty.

    Parameters
    ----------
    folder : a new or empty folder
    simulation : from `simulate` or `simulate_cell`
    rotation, transform, length : how the hand poses are written, as in ``capture.yaml``
    spots : whether the simulated pixels are written; without them pictures are needed
    pictures : render pictures and write them as ``images/{id}.png`` and ``images/{id}_off.png``
    state_noise : whether the capture says how large the noise is, as somebody who knows his robot
        would; the pixel noise is stated with the simulated pixels only
    progress : called with (pictures' shots written, shots to write)

    Returns
    -------
    Path
        Of ``capture.yaml``.

    Raises
    ------
    DataError
        The folder is not empty or cannot be written to, a convention is unknown, or there are
        neither spots nor pictures.
    """
    from lasercal_gtsam.io.capture import CAPTURE_FILE
    from lasercal_gtsam.io.capture_writer import write_capture
    from lasercal_gtsam.io.files import whole_folder, write_text
    from lasercal_gtsam.io.plain import to_json

    with whole_folder(folder, last=CAPTURE_FILE) as staging:
        write_capture(
            staging,
            simulation.observations,
            transform=transform,
            length=length,
            rotation=rotation,
            with_spots=spots,
            images=_patterns(pictures),
            noise=_stated(simulation.noise, spots) if state_noise else None,
            known=simulation.known,
        )
        write_text(staging / TRUTH_FILE, to_json(truth_to_dict(simulation)) + "\n")
        if pictures is not None:
            _write_pictures(staging, simulation, pictures, progress)
    return Path(folder) / CAPTURE_FILE


def truth_to_dict(simulation: Simulation) -> dict[str, Any]:
    """What ``truth.json`` holds.

    Cameras, lasers and planes as in ``calibration.json``; the pixel of every spot without pixel
    noise; the noise; preset and seed.
    """
    from lasercal_gtsam.io.plain import cell_to_dict, plain

    ids = [str(label) for label in simulation.observations.id]
    return {
        "format": TRUTH_FORMAT,
        "version": 1,
        **cell_to_dict(simulation.truth),
        "spots": [
            {"id": label, "uv_px": uv}
            for label, uv in zip(ids, simulation.uv_true.tolist(), strict=True)
        ],
        "noise": plain(simulation.noise),
        "preset": simulation.preset,
        "seed": simulation.seed,
    }


def load_truth(path: str | Path) -> Cell:
    """Read the true cell from ``truth.json``, or from the folder it lies in.

    Raises
    ------
    DataError
        The file is missing or holds no truth.
    """
    from lasercal_gtsam.io.cell_file import load_cell

    path = Path(path) / TRUTH_FILE if Path(path).is_dir() else Path(path)
    return load_cell(path, formats=(TRUTH_FORMAT,))


def _patterns(pictures: PictureOptions | None) -> dict[str, Any] | None:
    if pictures is None:
        return None
    patterns: dict[str, Any] = {"on": _ON}
    if pictures.off:
        patterns["off"] = _OFF
    if pictures.render.saturation_dn is not None:
        patterns["saturation"] = pictures.render.saturation_dn
    return patterns


def _stated(noise: Noise, spots: bool) -> dict[str, float] | None:
    stated = {
        "pixel": noise.pixel_px if spots else 0.0,
        "hand_translation_mm": noise.hand_translation_m * MM_PER_M,
        "hand_rotation_deg": noise.hand_rotation_rad * DEG_PER_RAD,
    }
    return {name: value for name, value in stated.items() if value > 0} or None


def _write_pictures(
    folder: Path,
    simulation: Simulation,
    options: PictureOptions,
    progress: Callable[[int, int], None] | None,
) -> None:
    from lasercal_gtsam.io.pictures import write_png
    from lasercal_gtsam.simulate.pictures import render_pictures

    (folder / _ON).parent.mkdir()
    for done, shot in enumerate(render_pictures(simulation, options), start=1):
        write_png(folder / _ON.format(id=shot.id), shot.on)
        if options.off:
            write_png(folder / _OFF.format(id=shot.id), shot.off)
        if progress is not None:
            progress(done, len(simulation.observations))
