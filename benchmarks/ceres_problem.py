"""Build the C++ comparator, hand it a problem, read its answer."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lasercal_gtsam import Beam, Camera, Cell, Intrinsics, Observations, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of, make_pose

SOURCE = Path(__file__).parent / "ceres"


@dataclass(frozen=True)
class CeresRun:
    """Answer of the comparator; seconds per solve, cost is half the sum of squared pixels."""

    solve_min: float
    solve_median: float
    total_median: float
    iterations: int
    converged: bool
    initial_cost: float
    final_cost: float
    cell: Cell


def build(directory: Path) -> tuple[Path, Path]:
    """Compile the comparators (needs cmake, a C++ compiler and libceres-dev): tuned and plain."""
    for command in (
        ["cmake", "-S", str(SOURCE), "-B", str(directory), "-DCMAKE_BUILD_TYPE=Release"],
        ["cmake", "--build", str(directory)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return directory / "solve", directory / "solve_plain"


def beam_frame(beam: Beam) -> Array:
    """Constant frame (4, 4) in the hand about which the comparator's beam moves."""
    u = beam.direction_hand
    return make_pose(np.column_stack([basis_of(u), u]), beam.point_hand)


def write(path: Path, observations: Observations, start: Cell) -> None:
    """Write spots and start values as `solve.cpp` reads them; one camera, one laser."""
    (camera,) = start.cameras.values()
    (beam,) = start.lasers.values()
    planes = [start.planes[name] for name in observations.planes]
    frame = beam_frame(beam)
    head = [
        [len(observations), len(planes)],
        _pose(camera.T_base_camera),
        camera.intrinsics.vector,
        _pose(frame),
        np.zeros(4),
    ]
    for plane in planes:
        n = plane.normal_base
        head += [n, basis_of(n).T.ravel(), [plane.distance]]
    poses = observations.T_base_hand
    spots = np.column_stack(
        [
            observations.uv,
            poses[:, :3, :3].reshape(-1, 9),
            poses[:, :3, 3],
            observations.plane_index,
        ]
    )
    np.concatenate([*map(np.ravel, head), spots.ravel()]).astype(np.float64).tofile(path)


def run(
    binary: Path,
    problem: Path,
    observations: Observations,
    start: Cell,
    **options: str | float,
) -> CeresRun:
    """Solve a written problem; ``options`` are the binary's (solver, radius, tolerance, ...)."""
    flags = [part for name, value in options.items() for part in (f"--{name}", str(value))]
    done = subprocess.run(
        [str(binary), str(problem), *flags], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(done.stderr.strip())
    answer = json.loads(done.stdout)
    return CeresRun(
        solve_min=answer["solve_min"],
        solve_median=answer["solve_median"],
        total_median=answer["total_median"],
        iterations=answer["iterations"],
        converged=answer["converged"],
        initial_cost=answer["initial_cost"],
        final_cost=answer["final_cost"],
        cell=_cell(answer, observations, start),
    )


def _cell(answer: dict[str, list[float]], observations: Observations, start: Cell) -> Cell:
    ((camera_name, camera),) = start.cameras.items()
    ((laser_name, beam),) = start.lasers.items()
    frame = beam_frame(beam)
    a, b, x, y = answer["beam"]
    R = np.reshape(answer["R_base_camera"], (3, 3))
    found = Camera(
        Intrinsics(*answer["intrinsics"]),
        make_pose(R, np.array(answer["t_base_camera"])),
        camera.image_size,
    )
    line = Beam(
        frame[:3, :3] @ np.array([a, b, 1.0]),
        frame[:3, :3] @ np.array([x, y, 0.0]) + frame[:3, 3],
    )
    planes = np.reshape(answer["planes"], (-1, 4))
    return Cell(
        {camera_name: found},
        {laser_name: line},
        {
            name: Plane(row[:3], row[3])
            for name, row in zip(observations.planes, planes, strict=True)
        },
    )


def _pose(T: Array) -> Array:
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])
