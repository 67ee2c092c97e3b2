"""YAML 1.2 as plain data together with the line of every key."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_text

Location = tuple[str | int, ...]

# Far above what a person writes, far below what takes long: an alias that stands for lists of
# aliases makes millions of values out of ten lines.
_MOST_CHARACTERS, _MOST_VALUES, _DEEPEST = 1_000_000, 100_000, 50


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
        The file cannot be read, is empty, is not YAML (with line and column) or holds more than
        such a file can mean to.
    """
    return parse_yaml(read_text(path), path.name)


def parse_yaml(text: str, name: str) -> tuple[Any, Lines, list[tuple[Location, str]]]:
    """The same of a text; ``name`` is what messages call it."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
    from ruamel.yaml.reader import ReaderError

    if len(text) > _MOST_CHARACTERS:
        raise DataError(f"{name}: {len(text)} characters; expected {_MOST_CHARACTERS} at most")
    try:
        reader = YAML(typ="safe", pure=True)
        reader.allow_duplicate_keys = True
        with warnings.catch_warnings():  # an anchor named twice is YAML: the later one counts
            warnings.simplefilter("ignore", ReusedAnchorWarning)
            node = reader.compose(text)
        if node is None:
            raise DataError(f"{name}: the file is empty")
        visit = _Visit(name)
        visit.node(node, ())
        return reader.constructor.construct_document(node), Lines(visit.lines), visit.problems
    except RecursionError:
        raise DataError(f"{name}: {_TOO_DEEP}") from None
    except (ValueError, ArithmeticError, LookupError) as error:  # !!bool x, 2001-99-99
        raise DataError(f"{name}: not valid YAML: {error}") from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f":{mark.line + 1}:{mark.column + 1}" if mark else ""
        about = " ".join(part for part in (error.context, error.problem) if part)
        hint = _quoting_hint(text.splitlines()[mark.line : mark.line + 1] if mark else [])
        raise DataError(f"{name}{at}: not valid YAML: {about}{hint}") from None
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise DataError(
            f"{name}:{line}: not valid YAML: the character U+{ord(text[error.position]):04X} "
            "cannot be seen and is not allowed"
        ) from None
    except YAMLError as error:
        raise DataError(f"{name}: not valid YAML: {' '.join(str(error).split())}") from None


def _quoting_hint(line: list[str]) -> str:
    """Inside {...} YAML takes the braces of a placeholder for its own."""
    if line and re.search(r"\{(id|plane|camera|laser)\}", line[0]):
        return '; inside { } put a pattern in quotes: {on: "images/{id}.png"}'
    return ""


_TOO_DEEP = f"lists or mappings inside each other, more than {_DEEPEST} deep"


class _Visit:
    """Goes through a document; what an alias stands for counts each time."""

    def __init__(self, name: str) -> None:
        self.lines: dict[Location, int] = {}
        self.problems: list[tuple[Location, str]] = []
        self._name, self._count = name, 0

    def node(self, node: Any, at: Location) -> None:
        line = node.start_mark.line + 1
        self._count += 1
        if self._count > _MOST_VALUES:
            raise DataError(f"{self._name}:{line}: more than {_MOST_VALUES} values")
        if len(at) > _DEEPEST:
            raise DataError(f"{self._name}:{line}: {_TOO_DEEP}")
        self.lines.setdefault(at, line)
        if node.id == "mapping":
            self._mapping(node, at)
        elif node.id == "sequence":
            for k, value in enumerate(node.value):
                self.node(value, (*at, k))

    def _mapping(self, node: Any, at: Location) -> None:
        first: dict[str, int] = {}
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.id != "scalar":
                raise DataError(f"{self._name}:{line}: expected a word before ':', got a {key.id}")
            name = str(key.value)
            if name in first:
                problem = f"this key is already in line {first[name]}"
                self.problems.append(((*at, name), problem))
            first.setdefault(name, line)
            self.lines[(*at, name)] = line
            self.node(value, (*at, name))
