"""``capture.yaml``: what the head of a capture may say, checked all at once, with lines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, field_validator

from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.conventions import ROTATION_CHOICES, rotation_format
from lasercal_gtsam.io.schema import Location, Strict, dotted, validation_problems
from lasercal_gtsam.io.wording import at_most, cannot_be_a_name, did_you_mean, quoted
from lasercal_gtsam.io.yaml_text import Lines, read_yaml

# of the section noise, and their names among the options
HAND_KEYS = {"hand_translation_mm": "hand_sigma_m", "hand_rotation_deg": "hand_sigma_rad"}
KNOWN_NAMES = ("principal_point", "aspect", *INTRINSIC_NAMES)


def _name(value: Any) -> Any:
    """YAML reads the name 1 as a number; names of cameras and planes are text everywhere."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _visible(name: str) -> str:
    if (odd := cannot_be_a_name(name)) is not None:
        raise ValueError(odd)
    return name


def _sigma(value: float) -> float:
    """Sigmas are squared and divided by: 0, or a number for which both can be done."""
    if value and not SMALLEST_SIGMA <= value <= LARGEST_SIGMA:
        raise ValueError(f"expected 0, or {SMALLEST_SIGMA:g} to {LARGEST_SIGMA:g}; got {value:g}")
    return value


SMALLEST_SIGMA, LARGEST_SIGMA, LARGEST_KNOWN = 1e-9, 1e6, 1e9

Name = Annotated[str, BeforeValidator(_name), AfterValidator(_visible), Field(min_length=1)]
FileName = Annotated[str, AfterValidator(_visible), Field(min_length=1)]
Pixels = Annotated[int, Field(gt=0, le=65535)]
Sigma = Annotated[float, Field(ge=0), AfterValidator(_sigma)]


class CameraHead(Strict):
    """One camera."""

    name: Name = Field("camera", description="the camera's name")
    width: Pixels = Field(description="the picture's width in pixels, a whole number up to 65535")
    height: Pixels = Field(description="the picture's height in pixels, a whole number up to 65535")


class PosesHead(Strict):
    """Where the hand poses are and how they are written; nothing here has a default."""

    file: FileName = Field(description="the name of the CSV file with the hand poses")
    transform: Literal["T_base_hand", "T_hand_base"] = Field(
        description="T_base_hand (the hand's pose in the base, what controllers report) or "
        "T_hand_base (its inverse); none is assumed"
    )
    length: Literal["mm", "m"] = Field(description="mm or m; none is assumed")
    rotation: str = Field(
        description=f"one of {', '.join(ROTATION_CHOICES)}; none is assumed",
    )

    @field_validator("rotation")
    @classmethod
    def _known_format(cls, value: str) -> str:
        try:
            rotation_format(value)
        except DataError as error:
            raise ValueError(str(error).removeprefix("rotation: ")) from None
        return value


class SpotsHead(Strict):
    """A file of spots beside the poses."""

    file: FileName = Field(description="the name of the CSV file with the spots")


class ImagesHead(Strict):
    """The pictures: patterns relative to the capture's folder."""

    on: FileName = Field(description="the pattern of the pictures, such as images/{id}.png")
    off: FileName | None = Field(None, description="the pattern of the laser-off pictures")
    background: FileName | None = Field(
        None, description="a laser-off picture for all rows without one of their own"
    )
    saturation: float | None = Field(
        None, gt=0, description="the pixel value from which a pixel is saturated, above 0"
    )


class NoiseHead(Strict):
    """What the user knows about the noise, 1 sigma."""

    pixel: Sigma | None = Field(None, description="the pixel sigma, 0 or more")
    hand_translation_mm: Sigma = Field(
        0.0, description="the sigma of the hand's position per axis in mm, 0 or more"
    )
    hand_rotation_deg: Sigma = Field(
        0.0, description="the sigma of the hand's rotation per axis in degrees, 0 or more"
    )
    estimate: list[Literal["hand_translation_mm", "hand_rotation_deg"]] = Field(
        [], description=f"a list out of {', '.join(HAND_KEYS)}, which nobody knows"
    )


class CaptureHead(Strict):
    """The whole of ``capture.yaml``."""

    lasercal: Literal[1] = Field(description="1, the version of the format")
    camera: list[CameraHead] = Field(
        min_length=1, description="a mapping {name, width, height}, or a list of such mappings"
    )
    poses: PosesHead = Field(description="a mapping {file, transform, length, rotation}")
    spots: SpotsHead | None = Field(None, description="a mapping {file}")
    images: ImagesHead | None = Field(
        None, description="a pattern such as images/{id}.png, or a mapping {on, off, ...}"
    )
    planes: list[Name] | None = Field(None, description="a list of names")
    noise: NoiseHead | None = Field(
        None, description="a mapping {pixel, hand_translation_mm, hand_rotation_deg, estimate}"
    )
    known: dict[str, Any] = Field({}, description="a mapping from names to values")


def read_head(path: Path) -> tuple[CaptureHead, Lines]:
    """Read and check ``capture.yaml``; also returns where its keys stand.

    Raises
    ------
    DataError
        With every problem of the file, each as ``capture.yaml:16: poses.length: ...``.
    """
    data, lines, problems = read_yaml(path)
    if not isinstance(data, dict):
        raise DataError(f"{path.name}: expected a mapping of keys to values, got {data!r:.60}")
    normal, aliases = _without_short_forms(data)
    head: CaptureHead | None = None
    try:
        head = CaptureHead.model_validate(normal)
    except ValidationError as error:
        found = validation_problems(error, CaptureHead)
        problems += [(_unalias(location, aliases), text) for location, text in found]
    problems += _cross_checks(normal)
    if problems or head is None:
        numbered = sorted(
            (lines.of(location), dotted(location), text) for location, text in problems
        )
        raise DataError(
            *at_most([f"{path.name}:{line}: {key}: {text}" for line, key, text in numbered])
        )
    return head, lines


def _without_short_forms(data: dict[Any, Any]) -> tuple[dict[Any, Any], dict[Location, Location]]:
    """One camera becomes a list of one, a picture pattern a mapping; plus where they came from."""
    normal, aliases = dict(data), dict[Location, Location]()
    if isinstance(data.get("camera"), dict):
        normal["camera"] = [data["camera"]]
        aliases["camera", 0] = ("camera",)
    if isinstance(data.get("images"), str):
        normal["images"] = {"on": data["images"]}
        aliases["images", "on"] = ("images",)
    return normal, aliases


def _unalias(location: Location, aliases: Mapping[Location, Location]) -> Location:
    for long, short in aliases.items():
        if location[: len(long)] == long:
            return short + location[len(long) :]
    return location


def _cross_checks(data: Mapping[Any, Any]) -> list[tuple[Location, str]]:
    """What no single key can show; works on unchecked data, so that all problems come at once."""
    cameras = [c.get("name", "camera") for c in _list(data.get("camera")) if isinstance(c, dict)]
    names = [str(name) for name in cameras]
    problems: list[tuple[Location, str]] = []
    problems += [
        (("camera", k), f"two cameras have the name {name!r}; every camera needs its own")
        for k, name in enumerate(names)
        if name in names[:k]
    ]
    planes = [str(name) for name in _list(data.get("planes"))]
    problems += [
        (("planes", k), f"the plane {name!r} is there twice")
        for k, name in enumerate(planes)
        if name in planes[:k]
    ]
    if isinstance(data.get("spots"), dict) and isinstance(data.get("poses"), dict):
        file = data["spots"].get("file")
        if file is not None and file == data["poses"].get("file"):
            problems.append(
                (("spots", "file"), f"{file!r} is also the file of the poses; leave spots out")
            )
    known = data.get("known")
    if isinstance(known, dict):
        problems += [(("known", *at), text) for at, text in _known_problems(known, names)]
    return problems


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _known_problems(known: Mapping[Any, Any], cameras: list[str]) -> list[tuple[Location, str]]:
    problems: list[tuple[Location, str]] = []
    for key, value in known.items():
        camera, _, name = str(key).rpartition(".")
        if camera and camera not in cameras:
            problems.append(
                ((key,), f"there is no camera {quoted(camera)}{did_you_mean(camera, cameras)}")
            )
        if name not in KNOWN_NAMES:
            problems.append(
                (
                    (key,),
                    f"unknown name{did_you_mean(name, KNOWN_NAMES)}; allowed are "
                    f"{', '.join(KNOWN_NAMES)}",
                )
            )
        elif name == "principal_point":
            if not (isinstance(value, list) and len(value) == 2 and all(map(_pixel, value))):
                problems.append(((key,), f"expected [u0, v0] in pixels, got {value!r:.60}"))
            problems += [
                ((key,), f"{axis} is given here and on its own")
                for axis in ("u0", "v0")
                if f"{camera}.{axis}".lstrip(".") in known
            ]
        elif _finite(value) and abs(value) > LARGEST_KNOWN:
            problems.append(((key,), f"expected at most {LARGEST_KNOWN:g}, got {value!r:.60}"))
        elif not _finite(value):
            problems.append(((key,), f"expected a number, got {value!r:.60}"))
        elif name in ("aspect", "fu", "fv") and value <= 0:
            problems.append(((key,), f"expected a number above 0, got {value!r}"))
    return problems


def _pixel(value: Any) -> bool:
    return _finite(value) and abs(value) <= LARGEST_KNOWN


def _finite(value: Any) -> bool:
    # a whole number may be too long for math.isfinite
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and (isinstance(value, int) or math.isfinite(value))
    )
