"""Does the convention doctor find planted mistakes, and leave right captures alone?

``python tests/montecarlo/doctor_study.py planted out.jsonl`` plants every kind of mistake in 20
random cells, ``... right out.jsonl`` declares 200 random cells rightly; each adds one line for each
capture to the file, and goes on where it stopped. ``... table out.jsonl`` prints what was found.

A planted mistake is found if the verdict is that another reading fits far better, and that reading
is the right one (or, of mirrored pixels, a mirror image that no spot can tell from it).
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from coverage_study import results

import lasercal_gtsam as lc
from lasercal_gtsam.check.diagnosis import Diagnosis
from lasercal_gtsam.check.doctor import diagnose
from lasercal_gtsam.check.readings import MIRRORED, PixelReading, RawPoses, pose_readings
from lasercal_gtsam.io.capture_rows import inverse_poses
from lasercal_gtsam.io.conventions import columns_from_rotations, rotation_format
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, Simulation, simulate_cell
from lasercal_gtsam.simulate.cells import IMAGE_SIZE, random_plane

PIXEL_PX = 1.0
# how the controller writes its poses, and what the capture says instead
KINDS: dict[str, tuple[str, str, dict[str, str]]] = {
    "T_hand_base for T_base_hand": ("quat_wxyz", "T_base_hand", {"transform": "T_hand_base"}),
    "T_base_hand for T_hand_base": ("matrix", "T_hand_base", {"transform": "T_base_hand"}),
    "xyzw for wxyz": ("quat_wxyz", "T_base_hand", {"rotation": "quat_xyzw"}),
    "wxyz for xyzw": ("quat_xyzw", "T_base_hand", {"rotation": "quat_wxyz"}),
    "kuka for mitsubishi": ("mitsubishi", "T_base_hand", {"rotation": "kuka"}),
    "fanuc for kuka": ("kuka", "T_base_hand", {"rotation": "fanuc"}),
    "kawasaki for fanuc": ("fanuc", "T_base_hand", {"rotation": "kawasaki"}),
    "staubli for ur": ("ur", "T_base_hand", {"rotation": "staubli"}),
    "ur for yaskawa": ("yaskawa", "T_base_hand", {"rotation": "ur"}),
    "euler XYZ for zyx": ("euler:zyx:deg", "T_base_hand", {"rotation": "euler:XYZ:deg"}),
    "degrees for radians": ("rotvec_rad", "T_base_hand", {"rotation": "rotvec_deg"}),
    "radians for degrees": ("euler:ZYX:deg", "T_base_hand", {"rotation": "euler:ZYX:rad"}),
    "order and direction": (
        "mitsubishi",
        "T_hand_base",
        {"rotation": "kuka", "transform": "T_base_hand"},
    ),
    "matrix by columns": ("matrix", "T_base_hand", {}),
    **{reading.words: ("quat_wxyz", "T_base_hand", {}) for reading in MIRRORED},
}
FORMATS = ("quat_wxyz", "quat_xyzw", "matrix", "rotvec_rad", "kuka", "fanuc", "ur", "staubli",
           "kawasaki", "mitsubishi", "yaskawa", "euler:zyz:deg")  # fmt: skip


def random_cell(seed: int) -> Simulation:
    """Any camera, beam, mount and place; two or three planes; three groups of ten on each."""
    for attempt in range(100):
        rng = np.random.default_rng([seed, attempt])
        f = float(rng.uniform(450.0, 900.0))
        intrinsics = lc.Intrinsics(
            fu=f,
            fv=f * float(rng.uniform(0.99, 1.01)),
            u0=320.0 + float(rng.uniform(-15, 15)),
            v0=240.0 + float(rng.uniform(-15, 15)),
            k1=float(rng.uniform(-0.25, 0.05)),
        )
        R = rotation_exp(np.pi * rng.uniform(0, 1) * _direction(rng))
        camera = lc.Camera(intrinsics, make_pose(R, rng.uniform(-0.7, 0.7, 3)), IMAGE_SIZE)
        beam = lc.Beam(_direction(rng), rng.uniform(-0.06, 0.06, 3))
        planes: dict[str, lc.Plane] = {}
        try:
            for k in range(int(rng.integers(2, 4))):
                planes[str(k + 1)] = random_plane(camera, tuple(planes.values()), rng)
            cell = lc.Cell({"camera": camera}, {"laser": beam}, planes)
            return simulate_cell(cell, groups=3, noise=Noise(pixel_px=PIXEL_PX), seed=seed)
        except lc.DataError:
            continue
    raise AssertionError(f"no cell for seed {seed}")


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def written(
    T_base_hand: np.ndarray, rotation: str, transform: str, said: dict[str, str]
) -> RawPoses:
    """The pose table of a controller, under a declaration."""
    T = inverse_poses(T_base_hand) if transform == "T_hand_base" else T_base_hand
    numbers = columns_from_rotations(rotation, T[:, :3, :3])
    declared = {"rotation": rotation, "transform": transform, **said}
    columns = rotation_format(declared["rotation"]).columns
    ids = tuple(str(k) for k in range(len(T)))
    return RawPoses(ids, T[:, :3, 3], numbers, columns, declared["transform"], declared["rotation"])


def planted(kind: str, seed: int) -> dict[str, object]:
    """One mistake in one random cell, and what the doctor says."""
    made = random_cell(seed)
    rotation, transform, said = KINDS[kind]
    T, seen = made.observations.T_base_hand, made.observations
    mirror = next((reading for reading in MIRRORED if reading.words == kind), None)
    if mirror is not None:
        uv = mirror.apply(seen.uv, seen.image_size["camera"])
        if ((uv < 0) | (uv > np.array(IMAGE_SIZE) - 1)).any():
            # such captures are refused when they are read; here a picture that is large enough
            seen = replace(seen, image_size={"camera": (640, 640)})
        seen = replace(seen, uv=uv)
    wrong = T.copy()
    if kind == "matrix by columns":
        wrong[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    raw = written(wrong, rotation, transform, said)
    start = time.process_time()
    found = diagnose(seen, pose_readings(raw), lc.CalibrationOptions())
    return {
        "kind": kind,
        "seed": seed,
        "verdict": found.verdict,
        "found": found.verdict == "other" and is_right(found, raw, T, mirror),
        "best": found.best.words,
        "px": [found.declared.residual_px, found.best.residual_px],
        "seconds": time.process_time() - start,
    }


def is_right(found: Diagnosis, raw: RawPoses, T: np.ndarray, mirror: PixelReading | None) -> bool:
    """Whether the best reading gives the true hand poses, with the pixels mirrored back if so."""
    poses = {reading.words: reading.T_base_hand for reading in pose_readings(raw)}
    words = [judged.words for judged in (found.best, *found.alike)]
    if mirror is not None:
        return f"{raw.transform}, {raw.rotation}, {mirror.words}" in words
    return words[0] in poses and bool(np.abs(poses[words[0]] - T).max() < 1e-9)


def right(seed: int) -> dict[str, object]:
    """A random cell as it is, in one of the formats."""
    made = random_cell(seed)
    rotation = FORMATS[seed % len(FORMATS)]
    transform = ("T_base_hand", "T_hand_base")[(seed // len(FORMATS)) % 2]
    raw = written(made.observations.T_base_hand, rotation, transform, {})
    start = time.process_time()
    found = diagnose(made.observations, pose_readings(raw), lc.CalibrationOptions())
    return {
        "kind": "right",
        "seed": seed,
        "verdict": found.verdict,
        "found": found.verdict == "consistent",
        "best": found.best.words,
        "px": [found.declared.residual_px, found.best.residual_px],
        "seconds": time.process_time() - start,
    }


def print_table(path: Path) -> None:
    """One line for each kind."""
    lines = list(results(path))
    for kind in ("right", *KINDS):
        mine = [line for line in lines if line["kind"] == kind]
        if mine:
            good = sum(bool(line["found"]) for line in mine)
            verdicts = dict(Counter(str(line["verdict"]) for line in mine))
            print(f"{kind:32} {good:4d} of {len(mine):4d}   {verdicts}")
    for line in lines:
        if not line["found"]:
            print(f"  {line['kind']}, seed {line['seed']}: {line['verdict']}, {line['best']}, "
                  f"px {line['px']}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["planted", "right", "table"])
    parser.add_argument("out", type=Path)
    parser.add_argument("--cells", type=int)
    given = parser.parse_args()
    if given.what != "table":
        done = {(line["kind"], line["seed"]) for line in results(given.out)}
        cells = given.cells or (20 if given.what == "planted" else 200)
        kinds = list(KINDS) if given.what == "planted" else ["right"]
        with given.out.open("a") as file:
            for seed in range(cells):
                for kind in kinds:
                    if (kind, seed) not in done:
                        line = right(seed) if kind == "right" else planted(kind, seed)
                        file.write(json.dumps(line) + "\n")
                        file.flush()
    print_table(given.out)


if __name__ == "__main__":
    main()
