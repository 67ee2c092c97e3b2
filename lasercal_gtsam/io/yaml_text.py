"""YAML 1.2 as plain data together with the line of every key."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_text

Location = tuple[str | int, ...]


class Lines:
    """Line numbers of the keys of a YAML file."""

    def __init__(self, lines: dict[Location, int]) -> None:
        self._lines = lines

    def of(self, location: Location) -> int:
        """Line (from 1) of a key, or of the nearest key around it that the file has."""
        while location and location not in self._lines:
            location = location[:-1]
        return self._lines.get(location, 1)


def read_yaml(path: Path) -> tuple[Any, Lines, list[tuple[Location, str]]]:
    """Read one YAML document.

    Returns
    -------
    data : plain dicts, lists, strings and numbers
    lines : where each key stands
    problems : keys that are there twice, as (location, text); the first value is in
        ``data``

    Raises
    ------
    DataError
        The file cannot be read, is empty or is not YAML (with line and column).
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    text = read_text(path)
    try:
        node = _plain_yaml(YAML).compose(text)
        if node is None:
            raise DataError(f"{path.name}: the file is empty")
        lines: dict[Location, int] = {}
        problems: list[tuple[Location, str]] = []
        _visit(node, (), lines, problems)
        reader = _plain_yaml(YAML)
        reader.allow_duplicate_keys = True
        return reader.load(text), Lines(lines), problems
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        about = " ".join(part for part in (error.context, error.problem) if part)
        hint = _quoting_hint(text.splitlines()[mark.line : mark.line + 1] if mark else [])
        raise DataError(f"{path.name}{at}: not valid YAML: {about}{hint}") from None
    except YAMLError as error:
        raise DataError(f"{path.name}: not valid YAML: {error}") from None


def _quoting_hint(line: list[str]) -> str:
    """Inside {...} YAML takes the braces of a placeholder for its own."""
    if line and re.search(r"\{(id|plane|camera|laser)\}", line[0]):
        return '; inside { } put a pattern in quotes: {on: "images/{id}.png"}'
    return ""


def _plain_yaml(yaml_class: Any) -> Any:
    return yaml_class(typ="safe", pure=True)


def _visit(
    node: Any, at: Location, lines: dict[Location, int], problems: list[tuple[Location, str]]
) -> None:
    lines.setdefault(at, node.start_mark.line + 1)
    if node.id == "mapping":
        first: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(key.value), key.start_mark.line + 1
            if name in first:
                problems.append(((*at, name), f"this key is already in line {first[name]}"))
            first.setdefault(name, line)
            lines[(*at, name)] = line
            _visit(value, (*at, name), lines, problems)
    elif node.id == "sequence":
        for k, value in enumerate(node.value):
            _visit(value, (*at, k), lines, problems)
