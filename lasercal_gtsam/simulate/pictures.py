"""Pictures of a simulated capture, rendered one shot at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.simulate.render import (
    Picture,
    RenderOptions,
    Scene,
    make_scene,
    render_pair,
    spot_shape,
)
from lasercal_gtsam.simulate.simulation import Simulation
from lasercal_gtsam.simulate.streams import PICTURES, stream
from lasercal_gtsam.units import M_PER_MM

_SCENES, _SHOTS = range(2)


@dataclass(frozen=True)
class PictureOptions:
    """How pictures are taken.

    Attributes
    ----------
    render : camera, lamp, surface and laser
    beam_radius_m : radius at which the beam has 1/e^2 of its centre's intensity, metres
    off : whether a laser-off picture goes with every laser-on picture
    """

    render: RenderOptions = field(default_factory=RenderOptions)
    beam_radius_m: float = 1.0 * M_PER_MM
    off: bool = True

    def __post_init__(self) -> None:
        if not self.beam_radius_m > 0:
            raise DataError(
                f"PictureOptions.beam_radius_m: expected more than 0, got {self.beam_radius_m}"
            )


class Shot(NamedTuple):
    """The pictures of one spot and where its centre truly is (px)."""

    id: str
    uv: Array
    on: Picture
    off: Picture


def render_pictures(
    simulation: Simulation, options: PictureOptions | None = None
) -> Iterator[Shot]:
    """Render the pictures of every spot, lazily and in order.

    The simulation's pixel noise is left out, since a picture brings its own. Every plane keeps its
    surface and lamp; a picture depends on the simulation's seed and its place in the order only.

    Parameters
    ----------
    simulation : from `simulate` or `simulate_cell`
    options : how the pictures are taken; None: `PictureOptions()`
    """
    options = PictureOptions() if options is None else options
    seen = simulation.observations
    shapes = spot_shape(
        simulation.truth,
        simulation.T_base_hand_actual,
        seen.plane.tolist(),
        seen.camera.tolist(),
        seen.laser.tolist(),
        options.beam_radius_m,
    )
    scenes: dict[tuple[int, int], Scene] = {}
    for k, (uv, shape) in enumerate(zip(simulation.uv_true, shapes, strict=True)):
        where = int(seen.camera_index[k]), int(seen.plane_index[k])
        if where not in scenes:
            size = seen.image_size[str(seen.camera[k])]
            rng = stream(simulation.seed, PICTURES, _SCENES, *where)
            scenes[where] = make_scene(size, options.render, rng)
        rng = stream(simulation.seed, PICTURES, _SHOTS, k)
        on, off = render_pair(uv, shape, scenes[where], options.render, rng)
        yield Shot(str(seen.id[k]), uv, on, off)
