"""Ways to spoil a file: as bytes, as text with fields, as a YAML or JSON document.

Every function takes a `random.Random` and gives other content; the same generator state gives the
same content, so that an input is known by its number alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

NUMBERS = [
    "nan",
    "NaN",
    "inf",
    "-inf",
    "Infinity",
    "1e308",
    "-1e308",
    "1e300",
    "1e160",
    "1e155",
    "1e100",
    "1e16",
    "1e9",
    "1e6",
    "-1",
    "-0",
    "0",
    "0.0",
    "1",
    "2",
    "0.5",
    "1e-9",
    "1e-160",
    "1e-300",
    "1e-310",
    "5e-324",
    "1e999",
    "-1e999",
    "65535",
    "65536",
    "2147483648",
    "4294967296",
    "1000000000",
    "9223372036854775808",
    "18446744073709551616",
    "1e18",
    "1_000",
    "0x10",
    "1,5",
    "1.2.3",
    "+5",
    "--5",
    ".5",
    "5.",
    "1e",
    "1e+",
    "½",
    "１２",
    "٣",
    "0b1",
    "0o17",
    "1:30",
    "12e03",
    ".inf",
    ".nan",
    "1000000000000000000000000000000000000000",
]
WORDS = (
    "",
    " ",
    "\0",
    "\ufeff",
    "\u2028",
    "\x1b[31m",
    "\r",
    "\n",
    "\n\n\n",
    "\t",
    ",",
    ";",
    '"',
    "'",
    '""',
    ":",
    ": ",
    "- ",
    "{",
    "}",
    "[",
    "]",
    "{}",
    "[]",
    "&a [",
    "*a",
    "!!python/object/apply:os.getpid []",
    "!!binary x",
    "!!set {a}",
    "!!timestamp 2001-12-14",
    "<<: *a",
    "---",
    "...",
    "|",
    ">",
    "%YAML 3.0",
    "? [a, b]",
    "~",
    "null",
    "true",
    "false",
    "yes",
    "mm",
    "m",
    "inch",
    "T_hand_base",
    "quat_xyzw",
    "matrix",
    "rotvec_deg",
    "euler:zyz:rad",
    "euler:xxx:deg",
    "kuka",
    "../../x",
    "/",
    ".",
    "..",
    "a/b",
    "C:\\x",
    "x" * 300,
    "Käfig",
    "平面",
    "\U0001f916",
    "é",
    "\ud7ff",
    "{id}",
    "{plane}",
    "{0}",
    "*",
    "**",
    "[!",
    "used",
    "camera",
    "laser",
    "lasercal",
    "id",
    "u",
)
_NUMBER = re.compile(rb"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def token(rng: Random) -> str:
    return rng.choice(NUMBERS if rng.random() < 0.5 else WORDS)


# --- bytes --------------------------------------------------------------------------------------


def _flip(rng: Random, data: bytearray) -> None:
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _cut(rng: Random, data: bytearray) -> None:
    del data[rng.randrange(len(data)) :]


def _remove(rng: Random, data: bytearray) -> None:
    start = rng.randrange(len(data))
    del data[start : start + rng.choice((1, 2, 5, 20, 100))]


def _double(rng: Random, data: bytearray) -> None:
    start = rng.randrange(len(data))
    piece = data[start : start + rng.choice((1, 5, 20, 100))]
    at = rng.randrange(len(data))
    data[at:at] = piece * rng.choice((1, 1, 2, 50))


def _insert(rng: Random, data: bytearray) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = token(rng).encode("utf-8", "surrogatepass")


def _noise(rng: Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    length = rng.choice((1, 2, 4, 16))
    data[at : at + length] = rng.randbytes(length)


def _zeros(rng: Random, data: bytearray) -> None:
    at = rng.randrange(len(data))
    data[at : at + rng.choice((1, 4, 64))] = bytes(rng.choice((1, 4, 64)))


def _number(rng: Random, data: bytearray) -> None:
    found = list(_NUMBER.finditer(bytes(data)))
    if found:
        spot = rng.choice(found)
        data[spot.start() : spot.end()] = _other_number(rng, spot[0].decode()).encode()


def _other_number(rng: Random, text: str) -> str:
    if rng.random() < 0.5:
        return rng.choice(NUMBERS)
    factor = rng.choice(
        (-1.0, 1000.0, 0.001, 1 + 1e-9, 57.29577951308232, 0.017453292519943295, 0.0)
    )
    return repr(float(text) * factor)


BYTES: Sequence[Callable[[Random, bytearray], None]] = (
    _flip, _cut, _remove, _double, _insert, _noise, _zeros, _number, _number,
)  # fmt: skip


def spoil_bytes(rng: Random, content: bytes) -> bytes:
    """Content with one to three changes anywhere."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if data:
            rng.choice(BYTES)(rng, data)
    return bytes(data)


def splice(rng: Random, one: bytes, other: bytes) -> bytes:
    """The beginning of one file and the end of another."""
    return one[: rng.randrange(len(one) + 1)] + other[rng.randrange(len(other) + 1) :]


# --- tables -------------------------------------------------------------------------------------


def spoil_table(rng: Random, content: bytes) -> bytes:
    """A CSV file with cells, columns or rows changed."""
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        rng.choice(_TABLE)(rng, rows)
    text = rng.choice(("\n", "\n", "\n", "\r\n", "\r")).join(",".join(row) for row in rows)
    encoding = rng.choice(("utf-8",) * 12 + ("utf-8-sig", "utf-16", "latin-1"))
    return (text + rng.choice(("\n", "\n", "", "\n\n"))).encode(encoding, "replace")


def _cell(rng: Random, rows: list[list[str]]) -> None:
    row = rng.choice(rows)
    row[rng.randrange(len(row))] = token(rng)


def _scale_cell(rng: Random, rows: list[list[str]]) -> None:
    row = rng.choice(rows)
    at = rng.randrange(len(row))
    if _NUMBER.fullmatch(row[at].encode()):
        row[at] = _other_number(rng, row[at])


def _column(rng: Random, rows: list[list[str]]) -> None:
    """The same in a whole column."""
    at, what = rng.randrange(len(rows[0])), token(rng)
    change = rng.randrange(4)
    source = rng.randrange(len(rows[0]))
    factor = rng.choice((0.0, -1.0, 1000.0, 0.001, 1e150, 1e-200))
    for row in rows[1:]:
        if at >= len(row) or source >= len(row):
            continue
        if change == 0:
            row[at] = what
        elif change == 1:
            row[at] = rows[1][at] if at < len(rows[1]) else ""
        elif change == 2:
            row[at] = row[source]
        elif _NUMBER.fullmatch(row[at].encode()):
            row[at] = repr(float(row[at]) * factor)


def _title(rng: Random, rows: list[list[str]]) -> None:
    row = rows[0]
    at = rng.randrange(len(row))
    row[at] = rng.choice((token(rng), rng.choice(row), row[at].upper(), f" {row[at]} "))


def _move_column(rng: Random, rows: list[list[str]]) -> None:
    at, to = rng.randrange(len(rows[0])), rng.randrange(len(rows[0]))
    drop, twice = rng.random() < 0.3, rng.random() < 0.3
    for row in rows:
        if at < len(row):
            cell = row[at] if twice else row.pop(at)
            if not drop:
                row.insert(to, cell)
        if not row:
            row.append("")


def _row(rng: Random, rows: list[list[str]]) -> None:
    at = rng.randrange(len(rows))
    match rng.randrange(5):
        case 0 if len(rows) > 1:
            rows.pop(at)
        case 1:
            rows.insert(rng.randrange(len(rows) + 1), list(rows[at]))
        case 2:
            rows[:] = [*rows[:1], *([list(rows[-1])] * (len(rows) - 1))]
        case 3:
            rows[:] = rows[: max(1, rng.randrange(len(rows)))]
        case _:
            rows[at] = rows[at][: rng.randrange(len(rows[at])) + 1] + [token(rng)] * rng.randrange(
                3
            )


def _exchange(rng: Random, rows: list[list[str]]) -> None:
    one, other = rng.choice(rows), rng.choice(rows)
    at = rng.randrange(min(len(one), len(other)))
    one[at], other[at] = other[at], one[at]


_TABLE = (
    _cell,
    _cell,
    _scale_cell,
    _scale_cell,
    _column,
    _column,
    _title,
    _move_column,
    _row,
    _exchange,
)


# --- documents ----------------------------------------------------------------------------------


def spoil_json(rng: Random, content: bytes) -> bytes:
    """A JSON document with values, keys or whole parts changed."""
    data = json.loads(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = spoil_value(rng, data)
    return json.dumps(data, ensure_ascii=rng.random() < 0.5).encode("utf-8", "surrogatepass")


def spoil_value(rng: Random, data: Any) -> Any:
    """A document with one place changed; ``data`` itself is changed too."""
    place: Any = None
    key: Any = None
    here = data
    while isinstance(here, dict | list) and here and (place is None or rng.random() < 0.9):
        place, key = (
            here,
            rng.choice(list(here)) if isinstance(here, dict) else rng.randrange(len(here)),
        )
        here = place[key]
    if place is None:
        return _value(rng, data)
    match rng.randrange(8):
        case 0:
            del place[key]
        case 1 if isinstance(place, dict):
            place[token(rng)] = place.pop(key)
        case 1:
            place.insert(key, place[key])
        case 2 if isinstance(place, dict):
            place[token(rng)] = here
        case _:
            place[key] = _value(rng, here)
    return data


def _value(rng: Random, old: Any) -> Any:
    number = isinstance(old, int | float) and not isinstance(old, bool) and abs(old) < 1e300
    if number and rng.random() < 0.7:
        return rng.choice(
            [
                *(-old, old * 1000, old * 0.001, old + 1, old * (1 + 1e-7), int(old), str(old)),
                *(0, 1, -1, 1e9, 1e300, 1e155, 1e-300, 5e-324, 2**31, 2**63, 10**19, 10**400),
                *(float("nan"), float("inf"), "inf", "-inf", "nan", [old], None, True),
            ]
        )
    return rng.choice(
        [
            *(None, True, 0, -1, 1.5, 10**30, "", "x", token(rng), token(rng), str(old)[:50]),
            *([], {}, [[]], [None], {"": {}}, [[1, 2], [3]], [old], [old, old], {"a": old}),
        ]
    )


def spoil_yaml(rng: Random, content: bytes) -> bytes:
    """Lines and values of a YAML file changed, and things that only YAML has."""
    lines = content.decode().splitlines()
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(lines)) if lines else 0
        match rng.randrange(9) if lines else 8:
            case 0:
                lines.pop(at)
            case 1:
                lines.insert(rng.randrange(len(lines) + 1), lines[at])
            case 2:
                lines[at] = " " * rng.choice((0, 1, 2, 3, 40)) + lines[at].lstrip()
            case 3 | 4 | 5:
                key, colon, _ = lines[at].partition(":")
                lines[at] = f"{key}{colon or ':'} {token(rng)}"
            case 6:
                lines[at] = _NUMBER.sub(
                    lambda _: token(rng).encode(), lines[at].encode(), 1
                ).decode()
            case 7:
                lines[at] = re.sub(r"[\w.{}]+", lambda _: token(rng), lines[at], count=1)
            case _:
                lines.insert(at, rng.choice(_YAML)(rng))
    return (
        rng.choice(("\n", "\n", "\n", "\r\n")).join([*lines, ""]).encode("utf-8", "surrogatepass")
    )


def _bomb(rng: Random) -> str:
    depth, width = rng.choice(((9, 9), (30, 2), (4, 50)))
    lines = ["l0: &l0 [x, x]"]
    lines += [f"l{k}: &l{k} [{', '.join([f'*l{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines)


_YAML: Sequence[Callable[[Random], str]] = (
    _bomb,
    lambda rng: "known: " + "[" * rng.choice((10, 1000, 20000)),
    lambda rng: "noise: " + "{a: " * rng.choice((10, 5000)) + "1" + "}" * rng.choice((10, 500)),
    lambda rng: "loop: &loop [*loop]",
    lambda rng: "known: &k {a: *k}",
    lambda rng: "planes: [" + ", ".join(f"p{k}" for k in range(rng.choice((1, 100, 3000)))) + "]",
    lambda rng: f"known: {{{rng.choice(('fu', 'aspect', 'u0', 'k1', 'c.fu'))}: {token(rng)}}}",
    lambda rng: f"known: {{principal_point: [{token(rng)}, {token(rng)}]}}",
    lambda rng: f"noise: {{pixel: {token(rng)}, hand_translation_mm: {token(rng)}}}",
    lambda rng: f'images: {{on: "{token(rng)}", off: "{token(rng)}"}}',
    lambda rng: f"{token(rng)}: {token(rng)}",
    lambda rng: f"spots: {{file: {token(rng)}}}",
    lambda rng: f"planes: [{token(rng)}, {token(rng)}]",
    lambda rng: f"# {'x' * rng.choice((10, 100_000))}",
)  # fmt: skip
