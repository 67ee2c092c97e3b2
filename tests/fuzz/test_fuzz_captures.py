"""Whatever the files of a capture hold: they are read, or refused with file and line."""

from __future__ import annotations

import os
from pathlib import Path
from random import Random

import numpy as np
import pytest
from fuzz_mutate import spoil_bytes, spoil_table, spoil_yaml
from fuzz_oracle import run, snapshot
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import load_capture
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.io.conventions import ROTATION_FORMATS
from lasercal_gtsam.observations import Observations

PROPERTY = settings(
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
HEAD = """\
lasercal: 1
camera: {name: camera, width: 640, height: 480}
poses:
  file: poses.csv
  transform: T_base_hand
  length: mm
  rotation: quat_wxyz
spots: {file: spots.csv}
noise: {pixel: 0.5, hand_translation_mm: 0.1}
known: {principal_point: [320, 240], skew: 0}
"""
POSES = """\
id,plane,x,y,z,qw,qx,qy,qz
1,table,1000,-200,300,1,0,0,0
2,table,1100,-200,300,0,1,0,0
3,wall,1200,0,300,0,0,0.6,0.8
"""
SPOTS = """\
id,u,v,sigma_u,sigma_v,rho_uv,verdict,reason
1,100,200,0.5,0.5,0.1,used,
2,639,0,0.5,0.5,,used,
3,,,,,,faint,nothing to be seen
"""


def written(folder: Path, **files: bytes) -> Path:
    """A capture with some of its files replaced (``poses_csv`` for poses.csv)."""
    content = {"capture.yaml": HEAD, "poses.csv": POSES, "spots.csv": SPOTS}
    for name, text in content.items():
        path = folder / name
        if path.is_dir():
            path.rmdir()
        path.write_bytes(files.get(name.replace(".", "_"), text.encode()))
    return folder


def problems_of(folder: Path) -> tuple[str, ...]:
    """What is wrong with a capture; nothing where it can be read."""
    try:
        load_capture(folder)
    except DataError as error:
        assert error.problems
        return error.problems
    return ()


def check_words(problems: tuple[str, ...], *names: str) -> None:
    for problem in problems:
        assert "\n" not in problem and len(problem) < 1500, problem
        assert problem.startswith("... and ") or any(name in problem for name in names), problem


ANY = st.randoms(use_true_random=False)


@pytest.mark.parametrize("spoil", [spoil_table, spoil_bytes], ids=["cells", "bytes"])
@pytest.mark.parametrize("name", ["poses.csv", "spots.csv"])
@PROPERTY
@given(seed=st.integers(0, 2**32))
def test_a_spoilt_table_is_read_or_refused_by_name(tmp_path: Path, name, spoil, seed: int) -> None:
    good = {"poses.csv": POSES, "spots.csv": SPOTS}[name].encode()
    folder = written(tmp_path, **{name.replace(".", "_"): spoil(Random(seed), good)})
    check_words(problems_of(folder), "poses.csv", "spots.csv")


@pytest.mark.parametrize("spoil", [spoil_yaml, spoil_bytes], ids=["lines", "bytes"])
@PROPERTY
@given(seed=st.integers(0, 2**32))
def test_a_spoilt_head_is_read_or_refused_by_name(tmp_path: Path, spoil, seed: int) -> None:
    folder = written(tmp_path, capture_yaml=spoil(Random(seed), HEAD.encode()))
    # another name of a table may come out of it, and that table is not there
    check_words(problems_of(folder), "capture.yaml", "poses", "spots", str(tmp_path))


TEXTS = st.text(max_size=20) | st.sampled_from(
    ["1e999", "nan", "-inf", "1e-320", "0x10", "1,5", "../x"]
)


@PROPERTY
@given(cells=st.lists(TEXTS, min_size=9, max_size=9))
def test_any_row_at_all(tmp_path: Path, cells: list[str]) -> None:
    row = ",".join('"' + cell.replace('"', '""') + '"' for cell in cells)
    folder = written(tmp_path, poses_csv=f"{POSES}{row}\n".encode("utf-8", "surrogatepass"))
    problems = problems_of(folder)
    check_words(problems, "poses.csv", "spots.csv")


@PROPERTY
@given(content=st.binary(max_size=300))
def test_any_bytes_at_all(tmp_path: Path, content: bytes) -> None:
    for name in ("capture_yaml", "poses_csv", "spots_csv"):
        assert problems_of(written(tmp_path, **{name: content})), name


@PROPERTY
@given(
    number=st.floats(allow_nan=False, allow_infinity=False),
    column=st.sampled_from(["x", "y", "z", "qw", "qx"]),
)
def test_any_number_in_a_pose(tmp_path: Path, number: float, column: str) -> None:
    """Read as it stands, or refused: never another number, never infinite on the way."""
    lines = POSES.splitlines()
    at = lines[0].split(",").index(column)
    cells = lines[1].split(",")
    cells[at] = repr(number)
    lines[1] = ",".join(cells)
    folder = written(tmp_path, poses_csv="\n".join([*lines, ""]).encode())
    problems = problems_of(folder)
    if column in "xyz" and abs(number) <= 1e9:
        assert load_capture(folder).T_base_hand[0, "xyz".index(column), 3] == number / 1000
    elif column in "xyz":
        assert problems[0].startswith("poses.csv:2: ")
    check_words(problems, "poses.csv:2: ")


# --- writing and reading again ------------------------------------------------------------------

NAMES = st.text(
    st.characters(codec="utf-8", categories=("L", "N", "P", "S")), min_size=1, max_size=8
)


@pytest.mark.parametrize("rotation", [*ROTATION_FORMATS, "euler:zyz:rad"])
@settings(PROPERTY, max_examples=5)
@given(seed=st.integers(0, 2**32), plane=NAMES, laser=NAMES)
def test_what_was_written_is_read(
    tmp_path: Path, rotation: str, seed: int, plane: str, laser: str
) -> None:
    rng = np.random.default_rng(seed)
    count = 5
    Q, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Q * np.sign(np.linalg.det(Q))[:, None, None]
    T[:, :3, 3] = rng.normal(size=(count, 3))
    seen = Observations.from_arrays(
        rng.uniform(0, 100, (count, 2)), T, plane=plane, laser=laser, image_size=(101, 101),
        sigma_px=rng.uniform(0.1, 2.0, count),
    )  # fmt: skip
    folder = tmp_path / str(seed)
    folder.mkdir(exist_ok=True)
    written_as = {"transform": "T_hand_base", "length": "mm", "rotation": rotation}
    write_capture(folder, seen, **written_as, with_spots=True)
    again = load_capture(folder).observations()
    assert set(again.plane.tolist()) == {plane} and set(again.laser.tolist()) == {laser}
    np.testing.assert_array_equal(again.uv, seen.uv)
    np.testing.assert_allclose(again.T_base_hand, seen.T_base_hand, atol=1e-14)
    np.testing.assert_allclose(again.cov_uv, seen.cov_uv, rtol=1e-14)


# --- files that are none ------------------------------------------------------------------------


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _loop(path: Path) -> None:
    path.symlink_to(path.with_name("other"))
    path.with_name("other").symlink_to(path)


@pytest.mark.parametrize("name", ["capture.yaml", "poses.csv", "spots.csv"])
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_pipe, "this is a pipe or a device, expected a file"),
        (lambda path: path.symlink_to("/dev/zero"), "this is a pipe or a device, expected a file"),
        (_loop, "symbolic links"),
        (lambda path: path.symlink_to("nowhere"), "there is no such file or folder"),
        (lambda path: path.write_bytes(b"\xff\xfea\0"), "UTF-16"),
        (lambda path: path.write_bytes(b"a\xffb"), "byte 0xff is not UTF-8 text"),
        (lambda path: path.write_bytes(b""), "the file is empty"),
    ],
    ids=["pipe", "device", "loop", "nowhere", "utf-16", "not utf-8", "empty"],
)
def test_what_is_no_file(tmp_path: Path, name: str, make, words: str) -> None:
    path = written(tmp_path) / name
    path.unlink()
    make(path)
    # given as the file itself: a folder without a regular capture.yaml holds no capture
    outcome = run(["calibrate", str(tmp_path / "capture.yaml")])
    assert (outcome.status, outcome.faults) == (1, [])
    assert words in outcome.err and name in outcome.err, outcome.err


def test_a_folder_in_place_of_a_file(tmp_path: Path) -> None:
    written(tmp_path)
    (tmp_path / "poses.csv").unlink()
    (tmp_path / "poses.csv").mkdir()
    outcome = run(["calibrate", str(tmp_path)])
    assert outcome.status == 1 and "this is a folder, expected a file" in outcome.err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    written(tmp_path)
    (tmp_path / "poses.csv").chmod(0)
    outcome = run(["calibrate", str(tmp_path)])
    assert outcome.status == 1 and "permission denied" in outcome.err


# --- YAML that makes much of little ---------------------------------------------------------------


def _bomb(depth: int, width: int) -> str:
    lines = ["l0: &l0 [x, x]"]
    lines += [f"l{k}: &l{k} [{', '.join([f'*l{k - 1}'] * width)}]" for k in range(1, depth)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (_bomb(9, 9), "more than 100000 values"),
        ("known: &k {a: *k}", "inside each other"),
        ("known: " + "[" * 20_000, "inside each other"),
        ("known: " + "{a: " * 60 + "1" + "}" * 60, "inside each other"),
        ("a: !!timestamp 2001-99-99", "not valid YAML: month"),
        ("a: !!bool x", "not valid YAML"),
        ("a: " + "1" * 5000, "not valid YAML"),
        ("? [a]\n: 1", "expected a word before ':'"),
        ("a: !!python/object/apply:os.getpid []", "could not determine a constructor"),
        ("a: '\0'", "the character U+0000"),
        ("planes: [a\u200b]", "U+200B"),
        ('planes: ["a\\u001b[31m"]', "U+001B"),
        ("#" + "x" * 1_000_000, "characters; expected 1000000 at most"),
    ],
)
def test_yaml_that_means_no_capture(tmp_path: Path, more: str, words: str) -> None:
    folder = written(tmp_path, capture_yaml=f"{HEAD}{more}\n".encode())
    outcome = run(["calibrate", str(folder)], limit_s=10)
    assert (outcome.status, outcome.faults) == (1, [])
    assert words in outcome.err and "capture.yaml" in outcome.err, outcome.err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("width: 640", "width: 1000000000", "camera.width: expected the picture's width in pixels"),
        ("pixel: 0.5", "pixel: 1e-300", "noise.pixel: expected 0, or 1e-09 to 1e+06; got 1e-300"),
        ("pixel: 0.5", "pixel: 1e300", "noise.pixel: expected 0, or 1e-09 to 1e+06; got 1e+300"),
        ("0.1}", "1e-200}", "noise.hand_translation_mm: expected 0, or"),
        ("skew: 0", "skew: 1e300", "known.skew: expected at most 1e+09, got 1e+300"),
        ("[320, 240]", "[320, 1e300]", "known.principal_point: expected [u0, v0] in pixels"),
    ],
)
def test_numbers_that_nobody_means_in_the_head(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    assert old in HEAD
    (problem,) = problems_of(written(tmp_path, capture_yaml=HEAD.replace(old, new).encode()))
    assert words in problem, problem


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "1,100,200,0.5",
            "1,100,200,1e-200",
            "sigma_u, sigma_v: expected numbers above 0 (at least",
        ),
        ("1,100,200,0.5", "1,100,200,1e200", "sigma_u: expected at most 1e+06, got '1e200'"),
        ("0.1,used", "0.9999999999999999,used", "rho_uv: expected a correlation in (-1, 1)"),
        ("1,100,200", "1\u200b,100,200", "id: '1\\u200b' holds U+200B, which cannot be seen"),
        ("1,100", f"1,{'9' * 5000}", "u: expected a finite number"),
    ],
)
def test_numbers_that_nobody_means_in_a_table(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    assert old in SPOTS
    problems = problems_of(written(tmp_path, spots_csv=SPOTS.replace(old, new, 1).encode()))
    assert words in problems[0], problems


def test_a_result_goes_to_no_device_and_through_no_loop(tmp_path: Path) -> None:
    from lasercal_gtsam.io.files import write_text

    _loop(tmp_path / "loop")
    before = snapshot(tmp_path)
    for target, words in (("/dev/null", "pipe or a device"), (tmp_path / "loop", "symbolic links")):
        with pytest.raises(DataError, match=words):
            write_text(target, "x")
    assert snapshot(tmp_path) == before


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    """Said at once, also by what looks into the place of its result before the work."""
    written(tmp_path)
    os.mkfifo(tmp_path / "calibration.json")
    outcome = run(["calibrate", str(tmp_path)])
    assert (outcome.status, outcome.faults) == (1, [])
    assert "calibration.json: cannot be written: this is a pipe" in outcome.err
