"""Small good files (the corpus), and for a number one of them spoilt, with a command."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz_mutate import splice, spoil_bytes, spoil_json, spoil_table, spoil_value, spoil_yaml, token
from fuzz_oracle import run
from fuzz_pictures import HEIGHT, WIDTH, encoded, spoilt, spot

SMALL = ("--preset", "paper-1", "--groups", "3", "--shots", "4")
FAST = ("--initial", "spots/truth.json", "--robust", "none", "--distortion", "none")
PICTURES = 2
LENSES = {
    "ros-camera-info": "camera.yaml",
    "kalibr": "chain.yaml",
    "opencv": "storage.yml",
    "mrcal": "lens.cameramodel",
}
_FIRST = (
    ("calibrate", "first", "-o", "first.json"),
    ("calibrate", "first", "--robust", "gnc-tls", "-o", "first.json"),
    ("check", "first"),
    ("calibrate", "two", "--robust", "huber", "-o", "first.json"),
    ("calibrate", "spots", "--distortion", "k1", "-o", "first.json"),
    ("check", "two"),
    ("judge", "two/calibration.json"),
    ("update", "spots/calibration.json", "more", "-o", "first.json"),
    ("report", "spots/calibration.json", "-o", "first.html"),
    ("compare", "spots/calibration.json", "two/calibration.json", "-o", "first.html"),
    ("plan", "spots/truth.json", "-n", "4"),
)


@dataclass(frozen=True)
class Input:
    """One input: which files are other than in the corpus, and the command that reads them."""

    kind: str
    args: tuple[str, ...]
    files: Mapping[str, bytes]
    stdin: bytes = b""
    results: tuple[str, ...] = ()


# --- the corpus ---------------------------------------------------------------------------------


def make_corpus(folder: Path) -> dict[str, bytes]:
    """Files by name below the folder that commands are run in."""
    here = Path.cwd()
    folder.mkdir(parents=True)
    os.chdir(folder)
    try:
        _run("simulate", "spots", *SMALL)
        _run("simulate", "matrix", *SMALL, "--rotation", "matrix", "--length", "m", "--seed", "1")
        _run("simulate", "two", "--preset", "paper-2", "--groups", "3", "--shots", "4")
        _run("calibrate", "spots", *FAST)
        _run("calibrate", "two", "--initial", "two/truth.json", "--distortion", "none")
        _with_spot_table()
        _with_pictures()
        _with_recording()
        Path("lens").mkdir()
        for form, name in LENSES.items():
            _run("export", "spots/calibration.json", form, "-o", f"lens/{name}")
        more = _renamed(Path("spots"), "more")
        _run("watch", more, "--calibration", "spots/calibration.json", "--once")
        _with_outliers("first")
        for args in _FIRST:  # compiles what inputs will need, which must not count as their time
            run(args, limit_s=600)
        shutil.rmtree("first")
    finally:
        os.chdir(here)
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith("first.") and path.suffix != ".writer"
    }


def _run(*args: str) -> None:
    outcome = run(args, limit_s=300)
    if outcome.status:
        raise RuntimeError(f"{args}: {outcome.status} {outcome.err} {outcome.trace}")


def _renamed(source: Path, name: str) -> str:
    """A capture with the first four rows of another, under new names."""
    target = source.parent / name
    target.mkdir()
    shutil.copy(source / "capture.yaml", target)
    rows = (source / "poses.csv").read_text().splitlines()[:5]
    (target / "poses.csv").write_text("\n".join([rows[0], *(f"m{row}" for row in rows[1:]), ""]))
    return name


def _with_outliers(name: str) -> None:
    """A capture of two planes with a fifth of the spots elsewhere."""
    shutil.copytree("two", name)
    path = Path(name) / "poses.csv"
    header, *rows = path.read_text().splitlines()
    at = header.split(",").index("u")
    for k in range(0, len(rows), 5):
        cells = rows[k].split(",")
        rows[k] = ",".join([*cells[:at], str(float(cells[at]) / 2.0), *cells[at + 1 :]])
    path.write_text("\n".join([header, *rows, ""]))


def _with_spot_table() -> None:
    """A capture whose spots are in a table of their own, with sigmas and verdicts."""
    folder = Path("tables")
    folder.mkdir()
    head = Path("spots/capture.yaml").read_text()
    (folder / "capture.yaml").write_text(head + "spots: {file: spots.csv}\nplanes: ['1']\n")
    rows = [line.split(",") for line in Path("spots/poses.csv").read_text().splitlines()]
    u, v = rows[0].index("u"), rows[0].index("v")
    assert (u, v) == (len(rows[0]) - 2, len(rows[0]) - 1)
    (folder / "poses.csv").write_text("".join(",".join(row[:-2]) + "\n" for row in rows))
    lines = ["id,u,v,sigma_u,sigma_v,rho_uv,verdict,reason"]
    lines += [f"{row[0]},{row[u]},{row[v]},0.5,0.4,0.1,used," for row in rows[1:]]
    (folder / "spots.csv").write_text("\n".join([*lines, ""]))


def _with_pictures() -> None:
    folder = Path("pictures")
    (folder / "images").mkdir(parents=True)
    (folder / "capture.yaml").write_text(
        f"lasercal: 1\ncamera: {{name: camera, width: {WIDTH}, height: {HEIGHT}}}\n"
        "poses:\n  file: poses.csv\n  transform: T_base_hand\n  length: mm\n  rotation: kuka\n"
        'images: {on: "images/{id}.png", off: "images/{id}_off.png"}\n'
    )
    lines = ["id,plane,x,y,z,a,b,c"]
    for k in range(PICTURES):
        lines.append(f"p{k},1,{500 + 10 * k},{7 * k},300,{3 * k},0,180")
        for name, lit in ((f"p{k}", True), (f"p{k}_off", False)):
            (folder / "images" / f"{name}.png").write_bytes(encoded(".png", spot(k, lit)))
    (folder / "poses.csv").write_text("\n".join([*lines, ""]))


def _with_recording() -> None:
    """Pictures named by their stamps, and a pose file of 10 Hz beside them."""
    Path("recording").mkdir()
    for k in range(2):
        picture = encoded(".png", spot(k))
        Path(f"recording/{k}.45.png").write_bytes(picture)
    lines = [f"{0.1 * k:.1f} 0.5 0.1 {0.3 + 0.01 * (k // 10)} 1 0 0 0" for k in range(31)]
    Path("poses.tum").write_text("\n".join([*lines, ""]))


# --- the inputs ---------------------------------------------------------------------------------

Corpus = Mapping[str, bytes]


def _calibrate(folder: str, *more: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return ("calibrate", folder, *FAST, *more), (f"{folder}/calibration.json",)


def _any(
    rng: Random, content: bytes, other: bytes, structured: Callable[[Random, bytes], bytes]
) -> bytes:
    kind = rng.random()
    if kind < 0.6:
        return structured(rng, content)
    return splice(rng, content, other) if kind < 0.65 else spoil_bytes(rng, content)


def _reading(rng: Random, kind: str, folder: str, files: Mapping[str, bytes]) -> Input:
    """A command that reads a capture: one that does no more, or one that goes on with it."""
    match rng.randrange(8):
        case 0:
            args, results = _calibrate(folder)
            return Input(f"{kind}, calibrate", args, files, results=results)
        case 1:
            args = ("update", "spots/calibration.json", folder, "-o", "out.json")
            return Input(f"{kind}, update", args, files, results=("out.json", "out.history.csv"))
        case _:  # there are no pictures to look at, it will say
            return Input(kind, ("detect", folder), files)


def head(rng: Random, corpus: Corpus) -> Input:
    folder = rng.choice(("spots", "tables", "matrix"))
    name = f"{folder}/capture.yaml"
    content = _any(rng, corpus[name], corpus["pictures/capture.yaml"], spoil_yaml)
    return _reading(rng, "capture.yaml", folder, {name: content})


def poses(rng: Random, corpus: Corpus) -> Input:
    folder = rng.choice(("spots", "matrix"))
    name = f"{folder}/poses.csv"
    content = _any(rng, corpus[name], corpus["tables/spots.csv"], spoil_table)
    return _reading(rng, "poses.csv", folder, {name: content})


def spots(rng: Random, corpus: Corpus) -> Input:
    content = _any(rng, corpus["tables/spots.csv"], corpus["spots/poses.csv"], spoil_table)
    return _reading(rng, "spots.csv", "tables", {"tables/spots.csv": content})


def both(rng: Random, corpus: Corpus) -> Input:
    """Poses that are read and spoilt, calibrated from nothing: no start is given."""
    folder = rng.choice(("spots", "matrix", "two"))
    files = {f"{folder}/poses.csv": spoil_table(rng, corpus[f"{folder}/poses.csv"])}
    known = rng.choice(
        ((), ("--known", f"fu={token(rng)}"), ("--robust", "none"), ("--robust", "huber"))
    )
    args = ("calibrate", folder, "--distortion", rng.choice(("none", "k1")), *known)
    return Input("poses.csv, no start", args, files, results=(f"{folder}/calibration.json",))


def check(rng: Random, corpus: Corpus) -> Input:
    folder = rng.choice(("spots", "matrix", "tables"))
    files = {f"{folder}/poses.csv": spoil_table(rng, corpus[f"{folder}/poses.csv"])}
    return Input("check", ("check", folder), files)


def _json_of(rng: Random, content: bytes, other: bytes) -> bytes:
    return _any(rng, content, other, spoil_json)


def calibration(rng: Random, corpus: Corpus) -> Input:
    folder = rng.choice(("spots", "two"))
    name = f"{folder}/calibration.json"
    files = {name: _json_of(rng, corpus[name], corpus["spots/truth.json"])}
    if rng.random() < 0.1:
        return Input("calibration.json, judge", ("judge", name), files)
    args = ("update", name, folder, "-o", "out.json")
    return Input("calibration.json", args, files, results=("out.json", "out.history.csv"))


def update(rng: Random, corpus: Corpus) -> Input:
    """A calibration that can be read, and spots that are new to it."""
    name = "spots/calibration.json"
    files = {"more/poses.csv": spoil_table(rng, corpus["more/poses.csv"])}
    if rng.random() < 0.5:
        files = {name: spoil_json(rng, corpus[name])}
    args = (
        "update",
        name,
        "more",
        "-o",
        "out.json",
        *rng.choice(((), ("--reset", "camera"), ("--automatic",))),
    )
    return Input("update", args, files, results=("out.json", "out.history.csv"))


def cell(rng: Random, corpus: Corpus) -> Input:
    files = {
        "spots/truth.json": _json_of(rng, corpus["spots/truth.json"], corpus["two/truth.json"])
    }
    args, results = _calibrate("spots")
    return Input("cell file", args, files, results=results)


def history(rng: Random, corpus: Corpus) -> Input:
    name = "more/calibration.history.csv"
    content = _any(rng, corpus[name], corpus["spots/poses.csv"], spoil_table)
    names = rng.choice(((), ("fu",), ("*",), (token(rng).replace("\0", "") or "x",)))
    args = ("history", name, *rng.choice(((), ("--json",))), "--", *names)
    return Input("history", args, {name: content})


def journal(rng: Random, corpus: Corpus) -> Input:
    name = "more/calibration.journal.jsonl"
    content = corpus[name]
    if rng.random() < 0.5:
        content = _resealed(rng, content)
    else:
        content = spoil_bytes(rng, content)
    files = {name: content}
    if rng.random() < 0.3:
        copy = f"{name}.start"
        files = {copy: spoil_bytes(rng, corpus[copy])}
    results = ("watch", "more/calibration.json", "more/calibration.history.csv", name)
    return Input("journal", ("watch", "more", "--once"), files, results=(*results, Path(name).name))


def _resealed(rng: Random, content: bytes) -> bytes:
    """A journal whose records are whole but say something else."""
    from lasercal_gtsam.io.journal_lines import sealed

    lines = content.splitlines(keepends=True)
    at = rng.randrange(len(lines))
    record = json.loads(lines[at])
    place = {"kind": record["kind"], "payload": record["payload"]}
    place = spoil_value(rng, place)
    if isinstance(place, dict) and isinstance(place.get("payload"), dict):
        kind = place.get("kind", "spot")
        try:
            seal = sealed(
                record["seq"], record["batch"], kind if at else record["kind"], place["payload"]
            )
            lines[at] = seal
        except Exception:
            lines[at] = spoil_bytes(rng, lines[at])
    else:
        lines.insert(at, lines[rng.randrange(len(lines))])
    return b"".join(lines)


def stdin(rng: Random, corpus: Corpus) -> Input:
    spot = {
        "id": "n1",
        "plane": "1",
        "uv": [300.0, 200.0],
        "T_base_hand": [[1.0, 0, 0, 0.5], [0, -1.0, 0, 0.1], [0, 0, -1.0, 0.4], [0, 0, 0, 1]],
        "sigma_px": 0.5,
    }
    columns = {"id": "n2", "plane": "1", "uv": [310.0, 220.0], "x": 500.0, "y": 100.0, "z": 400.0}
    columns |= {"qw": 0.0, "qx": 1.0, "qy": 0.0, "qz": 0.0, "cov_uv": [[1.0, 0.1], [0.1, 1.0]]}
    others: list[object] = [
        {"reset": {"camera": "camera"}},
        {"dismiss": True},
        {"image_size": [640, 480]},
    ]
    lines = []
    for _ in range(rng.choice((1, 1, 3))):
        document = json.dumps(rng.choice([spot, spot, columns, columns, *others])).encode()
        kind = rng.random()
        lines.append(spoil_json(rng, document) if kind < 0.6 else spoil_bytes(rng, document))
    start = ("--calibration", "spots/calibration.json") if rng.random() < 0.5 else ()
    args = ("watch", *rng.choice((("spots",), ())), "--stdin", "--once", "-o", "out.json", *start)
    ends = rng.choice((b"\n", b"\n", b"\r\n", b"\n\n"))
    results = ("watch", "out.json", "out.history.csv", "out.journal.jsonl")
    return Input("lines on stdin", args, {}, ends.join([*lines, b""]), results)


def picture(rng: Random, corpus: Corpus) -> Input:
    off = "_off" if rng.random() < 0.3 else ""
    name = f"pictures/images/p{rng.randrange(PICTURES)}{off}.png"
    results = ("pictures/spots.csv", "pictures/contact-sheet.png")
    return Input("picture", ("detect", "pictures"), {name: spoilt(rng)}, results=results)


def lens(rng: Random, corpus: Corpus) -> Input:
    name = f"lens/{rng.choice(list(LENSES.values()))}"
    content = (
        spoil_yaml(rng, corpus[name]) if rng.random() < 0.5 else spoil_bytes(rng, corpus[name])
    )
    args, results = _calibrate("spots")
    return Input("lens file", (*args, "--intrinsics", name), {name: content}, results=results)


def export(rng: Random, corpus: Corpus) -> Input:
    name = "spots/calibration.json"
    form = rng.choice((*LENSES, "ros-pose", "ros2-tf", "urdf", "json", "npz"))
    args = ("export", name, form, "-o", "out.x")
    return Input("export", args, {name: spoil_json(rng, corpus[name])}, results=("out.x",))


def pages(rng: Random, corpus: Corpus) -> Input:
    """What is written about a calibration: report, comparison, figures."""
    name = rng.choice(("spots/calibration.json", "two/calibration.json"))
    files = {name: spoil_json(rng, corpus[name])}
    figure = rng.choice(("residuals", "coverage", "error-map", "correlation", "cell"))
    both = rng.sample([name, "spots/calibration.json"], 2)
    kind, *args, output = rng.choice(
        (
            ("report", name, "page.html"),
            ("compare", *both, "page.html"),
            ("compare", *both, "page.html"),
            ("plot", name, figure, "page.png"),
        )
    )
    return Input(kind, (kind, *args, "-o", output), files, results=(output,))


def plan(rng: Random, corpus: Corpus) -> Input:
    if rng.random() < 0.5:
        name = "spots/truth.json"
        return Input("plan", ("plan", name, "-n", "4"), {name: _json_of(rng, corpus[name], b"{}")})
    word = token(rng).replace("\0", "")
    option = rng.choice((*_PLAN, "--rotation", "--planes", "--camera"))
    return Input("plan", ("plan", "spots/truth.json", "-n", "4", f"{option}={word}"), {})


def recording(rng: Random, corpus: Corpus) -> Input:
    if rng.random() < 0.7:
        files = {"poses.tum": spoil_bytes(rng, corpus["poses.tum"])}
    else:
        files = {"recording/0.45.png": spoilt(rng)}
    how = ("--pose-format", "tum", "--transform", "T_base_hand", "--names", "s", "--plane", "1")
    args = ("import", "recording", "--poses", "poses.tum", *how, "--laser-on", "--dry-run")
    return Input("recording", args, files)


def options(rng: Random, corpus: Corpus) -> Input:
    """Odd values of options, mostly for commands that end soon."""
    word = token(rng).replace("\0", "")
    fast, folder = _calibrate("spots")[0], "spots/calibration.json"
    update = ("update", folder, "more", "-o", "out.json")
    name = rng.choice(("fu", "u0", "aspect", "k1", "principal_point", "skew", "v0", word))
    part = rng.choice(("camera", "laser", "plane"))
    choices = (
        (*fast, rng.choice(("--known", "--fixed", "--sigma-px", "--robust", "--distortion")), word),
        (*fast, "--known", f"{name}={word}"),
        (*fast, "--fixed", f"{part}:{word}"),
        (*fast, "--sigma-px", rng.choice(("1e-300", "1e300", "1e-160", "1e160", "1e-9", "1e6"))),
        (*fast, "-o", word),
        ("calibrate", word),
        ("calibrate", "spots", "--initial", word),
        ("detect", "pictures", "--set", f"{rng.choice(_SETTINGS)}={word}"),
        ("detect", "pictures", "-o", word),
        (*update, "--reset", rng.choice((f"{part}:{word}", word, "laser", "plane:1"))),
        (*update, "--prefix", word),
        ("history", "more/calibration.json", word),
        ("history", "more/calibration.history.csv", "--plot", word),
        ("watch", "more", "--once", rng.choice(_WATCH), word),
        (rng.choice(("check", "judge", "check-sigma")), word),
        ("simulate", "new", rng.choice(_SIMULATE), word),
        ("simulate", "new", *SMALL, rng.choice(_NOISE), word),
        (word, "spots"),
        (rng.choice(_COMMANDS), rng.choice(("--", "-", word)), word),
    )
    return Input("options", rng.choice(choices), {}, results=("*",))


_SETTINGS = ("channel", "ambiguous_ratio", "saturation_level", "region", "threshold_sigmas", "x")
_WATCH = ("--max-spots", "--half-life", "--interval", "--until-idle", "--reset", "--journal")
_SIMULATE = ("--preset", "--seed", "--rotation", "--length", "--bits", "--ambient", "--transform")
_NOISE = ("--noise", "--pixel-px", "--hand-mm", "--hand-deg")
_PLAN = ("--beam-mm", "--box-mm", "--reach-mm", "--cone-deg", "--roll-deg", "--sigma-px")
_COMMANDS = ("calibrate", "check", "update", "detect", "history", "simulate", "judge", "watch")

KINDS: Mapping[Callable[[Random, Corpus], Input], float] = {
    head: 19,
    poses: 18,
    spots: 8,
    both: 0.6,
    check: 0.1,
    calibration: 12,
    update: 1.5,
    cell: 5,
    history: 10,
    journal: 3,
    stdin: 6,
    picture: 12,
    options: 3,
    lens: 4,
    export: 3,
    recording: 4,
    pages: 0.6,
    plan: 0.3,
}


def make_input(seed: int, number: int, corpus: Corpus) -> Input:
    """The input of that number."""
    rng = Random(f"{seed}:{number}")
    make = rng.choices(list(KINDS), list(KINDS.values()))[0]
    return make(rng, corpus)
