"""`lasercal simulate`: a capture of a cell whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from lasercal_gtsam.cli.console import json_option, print_json, progress, seed_option, warn, wrapped
from lasercal_gtsam.cli.outputs import capture_folder
from lasercal_gtsam.cli.pose_options import pose_options
from lasercal_gtsam.cli.texts import count
from lasercal_gtsam.cli.values import PresetName
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

if TYPE_CHECKING:
    from lasercal_gtsam.simulate import Noise
    from lasercal_gtsam.simulate.pictures import PictureOptions

_NOT_NEGATIVE = click.FloatRange(min=0)
_WRITTEN = {"capture.yaml", "poses.csv", "truth.json", "images"}


class _WithPresets(click.Command):
    """A command whose help ends with the presets; they are loaded only when it is shown."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from lasercal_gtsam.simulate.presets import PRESETS

        with formatter.section("Presets"):
            formatter.write_dl([(name, preset.description) for name, preset in PRESETS.items()])


@click.command(cls=_WithPresets, short_help="Write a capture of a cell whose truth is known.")
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--preset",
    type=PresetName(),
    metavar="NAME",
    default="paper",
    show_default=True,
    help="The cell and how the hand moves in it; listed below.",
)
@seed_option("The same seed gives the same capture to the last bit.")
@click.option(
    "--groups", metavar="N", type=click.IntRange(min=1), help="Hand rotations on every plane."
)
@click.option("--shots", metavar="N", type=click.IntRange(min=1), help="Poses per hand rotation.")
@click.option(
    "--noise",
    metavar="LEVEL",
    type=_NOT_NEGATIVE,
    default=1.0,
    show_default=True,
    help="Noise of pixels and hand, as a multiple of the preset's own; 0: exact.",
)
@click.option(
    "--pixel-px", metavar="PX", type=_NOT_NEGATIVE, help="Sigma of u and v instead of the preset's."
)
@click.option(
    "--hand-mm", metavar="MM", type=_NOT_NEGATIVE, help="Sigma of the hand's x, y, z, likewise."
)
@click.option(
    "--hand-deg", metavar="DEG", type=_NOT_NEGATIVE, help="Sigma of its rotation, likewise."
)
@pose_options
@click.option(
    "--pictures",
    is_flag=True,
    help="Write pictures, laser on and laser off, instead of the pixels of the spots.",
)
@click.option(
    "--bits",
    type=click.Choice(["8", "16"]),
    default="8",
    show_default=True,
    help="Depth of the pictures.",
)
@click.option(
    "--ambient",
    metavar="LEVEL",
    type=click.FloatRange(0, 1),
    help="Room light in the pictures, share of full scale.  [default: 0.2]",
)
@click.option("--force", is_flag=True, help="Replace a capture that is in OUT; other files stay.")
@json_option
def simulate(
    out: Path,
    preset: str,
    seed: int,
    groups: int | None,
    shots: int | None,
    noise: float,
    pixel_px: float | None,
    hand_mm: float | None,
    hand_deg: float | None,
    rotation: str,
    transform: Literal["T_base_hand", "T_hand_base"],
    length: Literal["mm", "m"],
    pictures: bool,
    bits: str,
    ambient: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write a simulated capture into the folder OUT, with the truth beside it (truth.json).

    Use it to try a setup before it is built, or to see how noise acts on the sigmas.
    """
    if not pictures and ambient is not None:
        raise click.UsageError("--ambient needs --pictures")

    from lasercal_gtsam.io.capture import CAPTURE_FILE
    from lasercal_gtsam.simulate import simulate as make
    from lasercal_gtsam.simulate import write_simulation
    from lasercal_gtsam.simulate.write import TRUTH_FILE

    with capture_folder(out, force) as folder:
        made = make(
            preset,
            seed,
            _noise(preset, noise, pixel_px, hand_mm, hand_deg),
            groups=groups,
            shots=shots,
        )
        with progress("Taking pictures") as show:
            write_simulation(
                folder,
                made,
                rotation=rotation,
                transform=transform,
                length=length,
                spots=not pictures,
                pictures=_picture_options(int(bits), ambient) if pictures else None,
                progress=show,
            )
    seen = made.observations
    others = sorted({path.name for path in out.iterdir()} - _WRITTEN)
    if others:
        warn([f"{', '.join(others)} in {out} are not of this capture and were left as they are"])
    if as_json:
        print_json(
            {
                "capture": str(out / CAPTURE_FILE),
                "truth": str(out / TRUTH_FILE),
                "preset": preset,
                "seed": seed,
                "noise": made.noise,
                "n_spots": len(seen),
                "planes": seen.planes,
                "repeated": made.repeated,
            }
        )
        return
    what = "pictures with laser on and off" if pictures else "spots"
    click.echo(
        f"{out}: {len(seen)} {what} on {count(len(seen.planes), 'plane')} "
        f"({', '.join(seen.planes)})"
    )
    if made.repeated:
        click.echo(
            wrapped(
                f"{count(made.repeated, 'shot')} had to be taken again, because noise moved the "
                "spot out of the picture."
            )
        )
    click.echo(f"The truth is in {out / TRUTH_FILE}. Next: lasercal calibrate {out}")


def _noise(
    preset: str, level: float, pixel_px: float | None, hand_mm: float | None, hand_deg: float | None
) -> Noise:
    """Scale the preset's noise, with single parts replaced."""
    from lasercal_gtsam.simulate.presets import PRESETS

    whole = PRESETS[preset].noise
    scaled = replace(
        whole,
        pixel_px=level * whole.pixel_px,
        hand_translation_m=level * whole.hand_translation_m,
        hand_rotation_rad=level * whole.hand_rotation_rad,
    )
    instead: dict[str, float] = {}
    if pixel_px is not None:
        instead["pixel_px"] = pixel_px
    if hand_mm is not None:
        instead["hand_translation_m"] = hand_mm * M_PER_MM
    if hand_deg is not None:
        instead["hand_rotation_rad"] = hand_deg * RAD_PER_DEG
    return replace(scaled, **instead)


def _picture_options(bits: int, ambient: float | None) -> PictureOptions:
    from lasercal_gtsam.simulate.pictures import PictureOptions
    from lasercal_gtsam.simulate.render import RenderOptions

    render = RenderOptions(bits=bits)
    if ambient is not None:
        render = replace(render, ambient_level=ambient)
    return PictureOptions(render)
