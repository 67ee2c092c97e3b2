"""Start-up of the command line: `lasercal calibrate` on 90 given spots against its heavy imports.

Runs the two in turns in fresh processes (compiled kernels cached) and prints the median ratio of
the pairs, and the wall time of `lasercal --help`.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from lasercal_gtsam import Observations
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.units import MM_PER_M

IMPORTS = [sys.executable, "-c", "import gtsam, numba, scipy"]
LASERCAL = str(Path(sys.executable).with_name("lasercal"))
HEAD = """\
lasercal: 1
camera: {{name: camera, width: {width}, height: {height}}}
poses: {{file: poses.csv, transform: T_base_hand, length: mm, rotation: matrix}}
noise: {{pixel: 1.0}}
"""


def write_capture(folder: Path, observations: Observations) -> Path:
    """Write a capture with given spots; return its head."""
    width, height = observations.image_size["camera"]
    rotation = [f"r{i}{j}" for i in "123" for j in "123"]
    with (folder / "poses.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["id", "plane", "x", "y", "z", *rotation, "u", "v"])
        for k, T in enumerate(observations.T_base_hand):
            numbers = np.concatenate([MM_PER_M * T[:3, 3], T[:3, :3].ravel(), observations.uv[k]])
            label = [str(observations.id[k]), str(observations.plane[k])]
            writer.writerow([*label, *(repr(float(x)) for x in numbers)])
    head = folder / "capture.yaml"
    head.write_text(HEAD.format(width=width, height=height))
    return head


def wall_time(command: list[str]) -> float:
    """Wall seconds of a command that must succeed."""
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begin
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=15)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        head = write_capture(folder, simulate("paper", 0, Noise(pixel_px=1.0)).observations)
        calibrate = [LASERCAL, "calibrate", str(head), "-o", str(folder / "calibration.json")]
        wall_time(calibrate)  # fills the kernel cache
        wall_time(IMPORTS)
        pairs = [(wall_time(calibrate), wall_time(IMPORTS)) for _ in range(args.pairs)]
        helps = [wall_time([LASERCAL, "--help"]) for _ in range(args.pairs)]
    ours, imports = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratios = sorted(a / b for a, b in pairs)
    print(f"lasercal calibrate, 90 spots: {ours:.3f} s; imports alone: {imports:.3f} s")
    print(
        f"ratio {statistics.median(ratios):.2f} (median of {len(ratios)} pairs, "
        f"{ratios[0]:.2f}-{ratios[-1]:.2f})"
    )
    print(f"lasercal --help: {statistics.median(helps):.3f} s (median of {len(helps)})")


if __name__ == "__main__":
    main()
