"""What pydantic found wrong, in sentences: what was found, what is allowed."""

from __future__ import annotations

import types
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from lasercal_gtsam.io.wording import did_you_mean, some

Location = tuple[str | int, ...]
_LONGEST_VALUE = 60


class Strict(BaseModel):
    """Base of the models: no unknown keys, no silent conversions, no NaN.

    The description of each field says what is expected there, as it goes into messages.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


def validation_problems(
    error: ValidationError, model: type[BaseModel]
) -> list[tuple[Location, str]]:
    """Every problem as (location of the key, sentence)."""
    return [(item["loc"], _sentence(item, model)) for item in error.errors(include_url=False)]


def dotted(location: Location) -> str:
    """``planes.1.name`` for a location."""
    return ".".join(str(part) for part in location)


def _sentence(item: Any, model: type[BaseModel]) -> str:
    location: Location = item["loc"]
    kind: str = item["type"]
    if kind == "extra_forbidden":
        _, owner = _look_up(model, location[:-1])
        allowed = list(owner.model_fields) if owner else []
        name = str(location[-1])
        return f"unknown key{did_you_mean(name, allowed)}; allowed are {', '.join(allowed)}"
    field, _ = _look_up(model, location)
    expected = field.description if field and field.description else None
    if kind == "missing":
        return f"left out; expected {expected}" if expected else "left out"
    if kind == "value_error":
        return str(item["ctx"]["error"])
    return f"expected {expected or _what(item['msg'])}, got {_shown(item['input'])}"


def _look_up(
    model: type[BaseModel], location: Location
) -> tuple[FieldInfo | None, type[BaseModel] | None]:
    """The innermost field on the way to a location, and the model that holds what is in it."""
    field: FieldInfo | None = None
    owner: type[BaseModel] | None = model
    is_name = False
    for part in location:
        if isinstance(part, int) or is_name:
            is_name = False
            continue
        if owner is None or part not in owner.model_fields:
            break
        field = owner.model_fields[part]
        owner = _model_in(field.annotation)
        is_name = get_origin(field.annotation) is dict
    return field, owner


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model inside ``Model``, ``Model | None``, ``list[Model]`` or ``dict[str, Model]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, types.UnionType, list, dict, tuple):
        for argument in get_args(annotation):
            found = _model_in(argument)
            if found is not None:
                return found
    return None


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return (
            f"a mapping with {some([str(key) for key in value])}" if value else "an empty mapping"
        )
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def _what(message: str) -> str:
    """``a valid number`` out of "Input should be a valid number"."""
    return message.removeprefix("Input should be ")
