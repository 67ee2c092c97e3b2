"""The cell of a study: one of the presets, or somebody's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lasercal_gtsam.cell import Camera, Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.calibration_model import CellModel
from lasercal_gtsam.io.plain import cell_to_dict
from lasercal_gtsam.simulate import Noise, Simulation, simulate_cell
from lasercal_gtsam.simulate.motions import design_named
from lasercal_gtsam.simulate.presets import preset_named
from lasercal_gtsam.simulate.streams import CELL, stream


@dataclass(frozen=True)
class StudyCell:
    """What is simulated in every trial: a cell, and how the hand moves in it.

    Attributes
    ----------
    preset : gives cell, groups, shots and design where these are None; a random part of its cell
        is drawn anew in every trial
    cell : somebody's own, with one camera and one laser, the same in every trial
    planes : names of the planes to use; None: all
    groups, shots : hand rotations per plane, and poses per rotation
    design : name of the motion design

    Raises
    ------
    DataError
        Unknown names, numbers that are none of groups or shots, or a cell with several cameras or
        lasers.
    """

    preset: str = "paper"
    cell: Cell | None = None
    planes: tuple[str, ...] | None = None
    groups: int | None = None
    shots: int | None = None
    design: str | None = None

    def __post_init__(self) -> None:
        chosen = preset_named(self.preset)
        if self.groups is None:
            object.__setattr__(self, "groups", chosen.groups)
        if self.shots is None:
            object.__setattr__(self, "shots", chosen.shots)
        if self.design is None:
            object.__setattr__(self, "design", chosen.design)
        design_named(str(self.design))
        if self.cell is not None and (len(self.cell.cameras), len(self.cell.lasers)) != (1, 1):
            raise DataError(
                f"study: the cell has {len(self.cell.cameras)} cameras and "
                f"{len(self.cell.lasers)} lasers; give one with one of each"
            )
        for what, value in (("groups", self.groups), ("shots", self.shots)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise DataError(f"study: {what}: expected an integer >= 1, got {value!r}")
        if self.planes is not None:
            there = self.truth(0).planes
            if not self.planes or len(set(self.planes)) < len(self.planes):
                raise DataError(f"study: planes: expected names, each once, got {self.planes}")
            if unknown := [name for name in self.planes if name not in there]:
                raise DataError(
                    f"study: plane {unknown[0]!r} is not in the cell, which has {', '.join(there)}"
                )

    @property
    def plane_count(self) -> int:
        """Number of planes with spots."""
        return len(self.truth(0).planes if self.planes is None else self.planes)

    def truth(self, seed: int) -> Cell:
        """The cell of a trial."""
        if self.cell is not None:
            return self.cell
        return preset_named(self.preset).cell(stream(seed, CELL))

    def camera(self, seed: int) -> Camera:
        """The camera of a trial."""
        (camera,) = self.truth(seed).cameras.values()
        return camera

    def simulated(self, seed: int, noise: Noise) -> Simulation:
        """The observations of a trial."""
        assert self.groups is not None
        assert self.shots is not None
        assert self.design is not None
        return simulate_cell(
            self.truth(seed),
            self.planes,
            self.groups,
            self.shots,
            seed=seed,
            noise=noise,
            design=self.design,
        )

    def to_plain(self) -> dict[str, Any]:
        """Say it in JSON."""
        return {
            "preset": self.preset,
            "cell": None if self.cell is None else cell_to_dict(self.cell),
            "planes": None if self.planes is None else list(self.planes),
            "groups": self.groups,
            "shots": self.shots,
            "design": self.design,
        }

    @classmethod
    def from_plain(cls, said: Mapping[str, Any]) -> StudyCell:
        """Read what `to_plain` said."""
        cell, planes = said["cell"], said["planes"]
        if cell is not None:
            cell = CellModel.model_validate(cell).build_cell("", [])
        planes = None if planes is None else tuple(planes)
        return cls(said["preset"], cell, planes, said["groups"], said["shots"], said["design"])
