"""Option values that are checked while the command line is read: wrong ones are usage errors."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.options import DISTORTION_NAMES

if TYPE_CHECKING:
    _ParamType = click.ParamType[Any]
else:  # no generic class before click 8.2
    _ParamType = click.ParamType

_LARGEST_NUMBER = 1e9  # of what is known of a camera, in any unit

Number = float | tuple[float, ...]


class Assignment(_ParamType):
    """``NAME=VALUE``, the value a number or several separated by commas."""

    name = "name=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, Number]:
        """Split into a name and a number or a tuple of numbers."""
        name, equals, text = str(value).partition("=")
        if not (name.strip() and equals):
            self.fail(f"{value!r} is not NAME=VALUE, such as skew=0", param, ctx)
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = (math.nan,)
        if not all(abs(number) <= _LARGEST_NUMBER for number in numbers):  # nor NaN
            self.fail(
                f"{value!r}: expected a number, or several separated by commas, behind '='",
                param,
                ctx,
            )
        return name.strip(), numbers[0] if len(numbers) == 1 else numbers


class Distortion(_ParamType):
    """``all``, ``none``, ``auto`` or names of distortion terms separated by commas."""

    name = "distortion"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> str | tuple[str, ...]:
        """Check the names."""
        if value in ("all", "none", "auto") or isinstance(value, tuple):
            return value  # type: ignore[no-any-return]
        names = tuple(name.strip() for name in str(value).split(","))
        if not set(names) <= set(DISTORTION_NAMES):
            allowed = ",".join(DISTORTION_NAMES)
            self.fail(f"{value!r} is not 'all', 'none', 'auto' or some of {allowed}", param, ctx)
        return names


class Setting(_ParamType):
    """``NAME=VALUE`` for a field of `DetectionOptions`."""

    name = "name=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, Any]:
        """Check the name, and the value as the detector would."""
        defaults = {f.name: f.default for f in fields(DetectionOptions)}
        name, equals, text = (part.strip() for part in str(value).partition("="))
        if not equals or name not in defaults:
            names = ", ".join(defaults)
            self.fail(f"{value!r} is not NAME=VALUE with a name out of {names}", param, ctx)
        try:
            setting = _setting(name, text, defaults[name])
            DetectionOptions(**{name: setting})
        except ValueError:
            self.fail(f"{name}: {text!r} is not {_KINDS.get(name, 'a number')}", param, ctx)
        except DataError as error:
            self.fail(str(error), param, ctx)
        return name, setting


_KINDS = {"divide_albedo": "true or false", "region": "u,v u,v u,v ... in pixels"}


def _setting(name: str, text: str, default: Any) -> Any:
    if name == "region":
        corners = [corner.split(",") for corner in text.split()]
        return tuple((float(u), float(v)) for u, v in corners)
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise ValueError
        return text == "true"
    if isinstance(default, str):
        return text
    return int(text) if isinstance(default, int) else float(text)


class Numbers(_ParamType):
    """Numbers between commas: so many of them, or any number where ``count`` is None."""

    name = "numbers"

    def __init__(self, count: int | None = None) -> None:
        self.count = count

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Split at the commas."""
        if isinstance(value, tuple):
            return value
        wanted = "numbers" if self.count is None else f"{self.count} numbers"
        try:
            found = tuple(float(part) for part in str(value).split(",") if part.strip())
        except ValueError:
            self.fail(f"expected {wanted} between commas, got {value!r}", param, ctx)
        if not all(map(math.isfinite, found)) or len(found) != (self.count or len(found)):
            self.fail(f"expected {wanted} between commas, got {value!r}", param, ctx)
        return found


class Names(_ParamType):
    """One name or several between commas, each once; out of ``choices`` where these are given."""

    name = "names"

    def __init__(self, *choices: str) -> None:
        self.choices = choices

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Split at the commas."""
        if isinstance(value, tuple):
            return value
        names = tuple(part.strip() for part in str(value).split(",") if part.strip())
        if not names or len(set(names)) < len(names):
            self.fail(f"expected names between commas, each once, got {value!r}", param, ctx)
        if self.choices and (unknown := [n for n in names if n not in self.choices]):
            self.fail(f"{unknown[0]!r} is not one of {', '.join(self.choices)}", param, ctx)
        return names


class PresetName(_ParamType):
    """Name of a simulated cell."""

    name = "preset"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check the name and spell it out."""
        from lasercal_gtsam.simulate.presets import preset_named

        try:
            return preset_named(str(value)).name
        except DataError as error:
            self.fail(str(error), param, ctx)


class RotationName(_ParamType):
    """Name of a rotation format as in ``capture.yaml``."""

    name = "format"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Check the name and spell it out."""
        from lasercal_gtsam.io.conventions import rotation_format

        try:
            return rotation_format(str(value)).name
        except DataError as error:
            self.fail(str(error).removeprefix("rotation: "), param, ctx)
