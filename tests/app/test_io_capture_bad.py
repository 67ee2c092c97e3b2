"""Captures that are wrong: one clear line for each problem, with file, place, found, allowed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import load_capture

HEAD = """\
lasercal: 1
camera: {name: camera, width: 640, height: 480}
poses:
  file: poses.csv
  transform: T_base_hand
  length: mm
  rotation: quat_wxyz
"""
POSES = """\
id,plane,x,y,z,qw,qx,qy,qz,u,v
1,table,1000,-200,300,1,0,0,0,100,200
2,table,1100,-200,300,0,1,0,0,639,0
3,wall,1200,0,300,0,0,0.6,0.8,0,479
"""
NO_PIXELS = "\n".join(line.rsplit(",", 2)[0] for line in POSES.splitlines()) + "\n"


def problems_of(
    tmp_path: Path, head: str = HEAD, poses: str | bytes | None = POSES, **files: str
) -> list[str]:
    (tmp_path / "capture.yaml").write_text(head)
    if poses is not None:
        content = poses if isinstance(poses, bytes) else poses.encode()
        (tmp_path / "poses.csv").write_bytes(content)
    for name, text in files.items():
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(DataError) as caught:
        load_capture(tmp_path)
    assert all("\n" not in problem for problem in caught.value.problems)
    return list(caught.value.problems)


def test_the_pattern_itself_is_right(tmp_path: Path) -> None:
    """So that every refusal below is due to the one thing that was changed."""
    (tmp_path / "capture.yaml").write_text(HEAD)
    (tmp_path / "poses.csv").write_text(POSES)
    assert load_capture(tmp_path).warnings == ()


# --- capture.yaml ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("  length: mm\n", "", "capture.yaml:3: poses.length: left out; expected mm or m"),
        (
            "  transform: T_base_hand\n",
            "",
            "capture.yaml:3: poses.transform: left out; expected T_base_hand (the hand's pose",
        ),
        (
            "  rotation: quat_wxyz\n",
            "",
            "capture.yaml:3: poses.rotation: left out; expected one of quat_wxyz, quat_xyzw, ma",
        ),
        ("length: mm", "length: cm", "capture.yaml:6: poses.length: expected mm or m; none is"),
        (
            "rotation: quat_wxyz",
            "rotation: kukka",
            "capture.yaml:7: poses.rotation: 'kukka' is not a known format (did you mean 'kuka'?)",
        ),
        (
            "rotation: quat_wxyz",
            "rotation: euler:xyz",
            "capture.yaml:7: poses.rotation: 'euler:xyz' is not of the form euler:<order>:",
        ),
        (
            "length:",
            "lenght:",
            "capture.yaml:6: poses.lenght: unknown key (did you mean 'length'?)",
        ),
        (
            "width: 640",
            "width: 640.5",
            "capture.yaml:2: camera.width: expected the picture's width",
        ),
        (
            "width: 640, ",
            "",
            "capture.yaml:2: camera.width: left out; expected the picture's width",
        ),
        ("width: 640", "width: -640", "capture.yaml:2: camera.width: expected the picture's width"),
        ("width: 640", "width: true", "capture.yaml:2: camera.width: expected the picture's width"),
        ("lasercal: 1\n", "", "capture.yaml:1: lasercal: left out; expected 1, the version"),
        ("lasercal: 1", "lasercal: 2", "capture.yaml:1: lasercal: expected 1, the version of the"),
        ("lasercal: 1", "lasercal: 1\nfoo: 3", "capture.yaml:2: foo: unknown key; allowed are las"),
        (
            "  length: mm\n",
            "  length: mm\n  length: m\n",
            "capture.yaml:7: poses.length: this key is already in line 6",
        ),
        ("poses:\n", "poses: 3\nposes:\n", "capture.yaml:4: poses: this key is already in line 3"),
        (
            "camera: {name: camera, width: 640, height: 480}",
            "camera: webcam",
            "capture.yaml:2: camera: expected a mapping {name, width, height}, or a list",
        ),
        ("length: mm", "length: [mm", "capture.yaml:7:11: not valid YAML: while parsing a flow"),
        ("  length: mm", "\tlength: mm", "capture.yaml:6:1: not valid YAML: while scanning"),
    ],
)
def test_head(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in HEAD
    problems = problems_of(tmp_path, HEAD.replace(old, new, 1))
    assert any(problem.startswith(expected) for problem in problems), problems
    # a misspelt key is also a missing one, and of two values for a key the first may be wrong
    assert len(problems) == (2 if new in ("lenght:", "poses: 3\nposes:\n") else 1)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("noise: {pixel: -1}", "noise.pixel: expected the pixel sigma, 0 or more, got -1"),
        ("noise: {pixel: .nan}", "noise.pixel: expected the pixel sigma, 0 or more, got nan"),
        ("noise: {pixel: '1'}", "noise.pixel: expected the pixel sigma, 0 or more, got '1'"),
        ("noise: {pixels: 1}", "noise.pixels: unknown key (did you mean 'pixel'?); allowed are p"),
        ("known: {skwe: 0}", "known.skwe: unknown name (did you mean 'skew'?); allowed are princ"),
        ("known: {skew: wide}", "known.skew: expected a number, got 'wide'"),
        ("known: {aspect: 0}", "known.aspect: expected a number above 0, got 0"),
        ("known: {principal_point: 320}", "known.principal_point: expected [u0, v0] in pixels"),
        (
            "known: {principal_point: [1, 2], v0: 3}",
            "known.principal_point: v0 is given here and on its own",
        ),
        ("known: {left.skew: 0}", "known.left.skew: there is no camera 'left'"),
        ("known: 5", "known: expected a mapping from names to values, got 5"),
        ("planes: [table, table, wall]", "planes.1: the plane 'table' is there twice"),
        ("spots: {file: poses.csv}", "spots.file: 'poses.csv' is also the file of the poses"),
        ("images: {off: a.png}", "images.on: left out; expected the pattern of the pictures"),
        ("images: [a.png]", "images: expected a pattern such as images/{id}.png, or a mapping"),
    ],
)
def test_optional_parts_of_the_head(tmp_path: Path, line: str, expected: str) -> None:
    (problem,) = problems_of(tmp_path, HEAD + line + "\n")
    assert problem.startswith(f"capture.yaml:8: {expected}"), problem


def test_all_problems_of_the_head_at_once_in_order(tmp_path: Path) -> None:
    head = (
        "lasercal: 1\ncamera:\n  - {name: a, width: 640}\n  - {name: a, width: 640, height: 480}\n"
        "poses:\n  file: poses.csv\n  transform: T_hand_bse\n  rotation: quat\n"
        "noise: {pixel: -1}\nknown: {skwe: 0}\nnose: 1\n"
    )
    problems = problems_of(tmp_path, head)
    assert [p.split(": ")[:2] for p in problems] == [
        ["capture.yaml:3", "camera.0.height"],
        ["capture.yaml:4", "camera.1"],
        ["capture.yaml:5", "poses.length"],
        ["capture.yaml:7", "poses.transform"],
        ["capture.yaml:8", "poses.rotation"],
        ["capture.yaml:9", "noise.pixel"],
        ["capture.yaml:10", "known.skwe"],
        ["capture.yaml:11", "nose"],
    ]


@pytest.mark.parametrize(
    ("head", "expected"),
    [
        ("", "capture.yaml: the file is empty"),
        ("- 1\n- 2\n", "capture.yaml: expected a mapping of keys to values, got [1, 2]"),
        ("just text", "capture.yaml: expected a mapping of keys to values, got 'just text'"),
        ("a: 1\n---\nb: 2\n", "capture.yaml:2:1: not valid YAML: expected a single document"),
        ("a: !!python/object:os.system x\n", "capture.yaml:1:4: not valid YAML"),
        (
            HEAD + "images: {on: images/{id}.png}\n",
            'inside { } put a pattern in quotes: {on: "images/{id}.png"}',
        ),
    ],
)
def test_heads_that_are_none(tmp_path: Path, head: str, expected: str) -> None:
    (problem,) = problems_of(tmp_path, head)
    assert expected in problem


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"there is no capture\.yaml in this folder"):
        load_capture(tmp_path)
    (tmp_path / "other.yaml").write_text(HEAD)
    with pytest.raises(DataError, match=r"it has other\.yaml: give one of them"):
        load_capture(tmp_path)
    with pytest.raises(DataError, match=r"no\.yaml: there is no such file"):
        load_capture(tmp_path / "no.yaml")
    (problem,) = problems_of(tmp_path, poses=None)
    assert problem.endswith("poses.csv: there is no such file or folder")


# --- poses.csv ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("1000", "abc", "poses.csv:2: x: expected a number, got 'abc'"),
        ("1000", "", "poses.csv:2: x: empty, expected a number"),
        ("1000", "nan", "poses.csv:2: x: expected a finite number, got 'nan'"),
        ("1000", "-Inf", "poses.csv:2: x: expected a finite number, got '-Inf'"),
        ("1000", "1e999", "poses.csv:2: x: expected a finite number, got '1e999'"),
        ("1000", "1_000", "poses.csv:2: x: expected a number, got '1_000'"),
        (
            "1000",
            '"1000,5"',
            "poses.csv:2: x: expected a number with a decimal point, got '1000,5'",
        ),
        (
            "1000",
            "1000,5",
            "poses.csv:2: 12 cells, expected 11 as in the first line; is there a dec",
        ),
        ("2,table,1100", "2,1100", "poses.csv:3: 10 cells, expected 11 as in the first line"),
        ("\n2,", "\n1,", "poses.csv:3: id: duplicate '1', already used in line 2"),
        ("\n2,", "\n,", "poses.csv:3: id: empty, expected a name"),
        ("3,wall", "3,", "poses.csv:4: plane: empty, expected a name"),
        (
            "300,1,0,0,0",
            "300,2,0,0,0",
            "poses.csv:2: qw, qx, qy, qz: quaternion of norm 2, expected 1 (within 0.001)",
        ),
        ("100,200", "100,", "poses.csv:2: v: empty, but u is given"),
        ("100,200", ",200", "poses.csv:2: u: empty, but v is given"),
        ("100,200", "640.5,200", "poses.csv:2: u: 640.5 lies outside the picture, whose pixels go"),
        (
            "100,200",
            "100,-1.5",
            "poses.csv:2: v: -1.5 lies outside the picture, whose pixels go fr",
        ),
        (",u,v", ",u,w", "poses.csv: column v missing, a spot needs both; the file has id, plane"),
        (
            "qw,qx,qy,qz",
            "q_w,qx,qy,qz",
            "poses.csv: column qw missing, needed by rotation quat_wxyz; the file has id, plane, "
            "x, y, z, q_w, qx, qy, qz, u, v (is 'q_w' meant as 'qw'?)",
        ),
        ("id,plane", "name,plane", "poses.csv: column id missing, which names each row; the file"),
        ("id,plane", "id,surface", "poses.csv: column plane missing, which names the working plan"),
        ("x,y,z", "x,y,x", "poses.csv: column z missing, the position of the hand"),
        ("id,plane,x", "id,plane,X,x", "poses.csv:1: column 'x' is there 2 times"),
    ],
)
def test_poses(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in POSES
    problems = problems_of(tmp_path, poses=POSES.replace(old, new, 1))
    assert any(p.startswith(expected) for p in problems), problems
    if "'x' is there" not in expected and "column z" not in expected:
        assert len(problems) == 1


@pytest.mark.parametrize(
    ("poses", "expected"),
    [
        ("", "poses.csv: the file is empty; expected a line of column names and rows"),
        ("\n\n , \n", "poses.csv: the file is empty"),
        (POSES.split("\n")[0] + "\n", "poses.csv: there are column names but no rows"),
        (POSES.replace(",", ";"), "poses.csv:1: the columns are separated by semicolons; expected"),
        (POSES.replace(",", "\t"), "poses.csv:1: the columns are separated by tabs; expected com"),
        (POSES.replace(",", " "), "poses.csv:1: the columns are separated by blanks; expected c"),
        # without its header a table looks like one with odd names
        (
            POSES.split("\n", 1)[1],
            "poses.csv: column id missing, which names each row; the file has",
        ),
        ("1,2,3\n4,5,6\n", "poses.csv:1: expected column names, got numbers: 1, 2, 3"),
        (POSES.encode("utf-16"), "poses.csv: the text is in UTF-16; save it as UTF-8"),
        (
            POSES.replace("table", "Fläche").encode("latin-1"),
            "poses.csv:2: byte 0xe4 is not UTF-8 text",
        ),
        (POSES.replace("1100", '"1100'), "poses.csv:4: not a row of CSV: unexpected end of data"),
    ],
)
def test_files_that_are_no_table(tmp_path: Path, poses: str | bytes, expected: str) -> None:
    problems = problems_of(tmp_path, poses=poses)
    assert expected in problems[0], problems


def test_all_problems_of_a_table_at_once(tmp_path: Path) -> None:
    poses = (
        POSES.replace("1000", "far")
        .replace("\n2,table", "\n1,table")
        .replace("0.6,0.8", "0.6,0.9")
        .replace("0,479", "0,nan")
        + "4,wall,1,2\n"
    )
    assert [p.split(": ")[:2] for p in problems_of(tmp_path, poses=poses)] == [
        ["poses.csv:2", "x"],
        ["poses.csv:3", "id"],
        ["poses.csv:4", "qw, qx, qy, qz"],
        ["poses.csv:4", "v"],
        ["poses.csv:5", "4 cells, expected 11 as in the first line"],
    ]


def test_a_long_list_is_cut_and_says_so(tmp_path: Path) -> None:
    rows = [f"{k},t,a,b,300,1,0,0,0,5,5" for k in range(100)]
    problems = problems_of(tmp_path, poses="\n".join([POSES.split("\n")[0], *rows]))
    assert len(problems) == 21
    assert problems[-1] == "... and 180 more problems"


def test_a_matrix_that_is_no_rotation(tmp_path: Path) -> None:
    names = ",".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
    poses = (
        f"id,plane,x,y,z,{names},u,v\n1,t,1,2,300,1,0,0,0,1,0,0,0,1,5,5\n"
        "2,t,1,2,300,1,0,0,0,1,0,0,0,-1,5,5\n3,t,1,2,300,1,0,0.1,0,1,0,0,0,1,5,5\n"
    )
    first, second = problems_of(tmp_path, HEAD.replace("quat_wxyz", "matrix"), poses)
    assert first.startswith("poses.csv:3: r11, r12") and "a reflection" in first
    assert second.startswith("poses.csv:4: r11, r12") and "not a rotation matrix" in second


def test_unknown_names(tmp_path: Path) -> None:
    poses = POSES.replace("3,wall", "3,wal").replace("plane,x", "plane,camera,x")
    poses = poses.replace("table,", "table,camera,").replace("wal,", "wal,kamera,")
    plane, camera = problems_of(tmp_path, HEAD + "planes: [table, wall]\n", poses)
    assert plane == (
        "poses.csv:4: plane: unknown plane 'wal' (did you mean 'wall'?); capture.yaml has table, "
        "wall"
    )
    assert camera.startswith(
        "poses.csv:4: camera: unknown camera 'kamera' (did you mean 'camera'?)"
    )


def test_several_cameras_need_a_column(tmp_path: Path) -> None:
    head = HEAD.replace(
        "camera: {name: camera, width: 640, height: 480}",
        "camera: [{name: a, width: 640, height: 480}, {name: b, width: 640, height: 480}]",
    )
    (problem,) = problems_of(tmp_path, head)
    assert problem.startswith(
        "poses.csv: column camera missing, needed because there are 2 cameras"
    )


@pytest.mark.parametrize(
    ("columns", "cells", "expected"),
    [
        ("sigma_u,sigma_v", "0,1", "poses.csv:2: sigma_u, sigma_v: expected numbers above 0"),
        ("sigma_u,sigma_v", "1,", "poses.csv:2: sigma_u, sigma_v: one is empty"),
        ("sigma_u,sigma_v,rho_uv", "1,1,1", "poses.csv:2: rho_uv: expected a correlation in (-1"),
        ("sigma_u", "1", "poses.csv: column sigma_v missing, a covariance needs both"),
        ("sigma_u,sigma_v", "1,x", "poses.csv:2: sigma_v: expected a number, got 'x'"),
    ],
)
def test_sigmas(tmp_path: Path, columns: str, cells: str, expected: str) -> None:
    header, row = POSES.splitlines()[:2]
    (problem,) = problems_of(tmp_path, poses=f"{header},{columns}\n{row},{cells}\n")
    assert problem.startswith(expected)


def test_a_sigma_without_its_pixel(tmp_path: Path) -> None:
    header, row = POSES.splitlines()[:2]
    poses = f"{header},sigma_u,sigma_v\n{row.replace('100,200', ',')},1,1\n"
    (problem,) = problems_of(tmp_path, poses=poses)
    assert problem.startswith("poses.csv:2: sigma_u, sigma_v: given without a pixel")


def test_no_spots_at_all(tmp_path: Path) -> None:
    (problem,) = problems_of(tmp_path, poses=NO_PIXELS)
    assert problem.startswith("capture.yaml: there are no spots: give columns u, v in poses.csv")


# --- spots.csv ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spots", "expected"),
    [
        ("id,u,v\n1,5,5\n9,5,5\n", "spots.csv:3: id: '9' is not in poses.csv"),
        ("id,u,v\n1,5,5\n1,6,6\n", "spots.csv:3: id: duplicate '1', already used in line 2"),
        ("id,u,v\n1,5,\n", "spots.csv:2: v: empty, but u is given"),
        ("id,u,v\n1,5,481\n", "spots.csv:2: v: 481 lies outside the picture"),
        ("id,u,v,verdict\n1,,,used\n", "spots.csv:2: u, v: empty, but the verdict is 'used'"),
        ("id,u\n1,5\n", "spots.csv: column v missing, the pixel of the spot"),
        ("u,v\n1,5\n", "spots.csv: column id missing, which says whose spot it is"),
    ],
)
def test_spot_table(tmp_path: Path, spots: str, expected: str) -> None:
    head = HEAD + "spots: {file: spots.csv}\n"
    (problem,) = problems_of(tmp_path, head, NO_PIXELS, spots=spots)
    assert problem.startswith(expected)


def test_spots_given_twice(tmp_path: Path) -> None:
    head = HEAD + "spots: {file: spots.csv}\n"
    (problem,) = problems_of(tmp_path, head, POSES, spots="id,u,v\n1,5,5\n")
    assert problem.startswith("poses.csv: spots are given here (columns u, v) and in spots.csv")


def test_problems_of_both_tables_at_once(tmp_path: Path) -> None:
    head = HEAD + "spots: {file: spots.csv}\n"
    poses = NO_PIXELS.replace("1000", "x")
    problems = problems_of(tmp_path, head, poses, spots="id,u,v\n1,5,x\n")
    assert [p.split(": ")[0] for p in problems] == ["poses.csv:2", "spots.csv:2"]


# --- pictures -------------------------------------------------------------------------------------


def test_missing_pictures_are_all_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((480, 640), np.uint8))
    head = HEAD + 'images: {on: "{id}.png", off: "{id}_off.png"}\n'
    problems = problems_of(tmp_path, head, NO_PIXELS)
    assert [p.replace(str(tmp_path), "") for p in problems] == [
        "id 1: the picture /1.png is missing",
        "id 3: the picture /3.png is missing",
        "id 1: the laser-off picture /1_off.png is missing",
        "id 2: the laser-off picture /2_off.png is missing",
        "id 3: the laser-off picture /3_off.png is missing",
    ]


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("'{idd}.png'", "images.on: unknown placeholder {idd} (did you mean 'id'?); allowed are"),
        ("'shots/*.png'", "images.on: 'shots/*.png' matches 4 pictures, but there are 3 rows"),
        ("'none/*.png'", "images.on: 'none/*.png' matches 0 pictures, but there are 3 rows"),
        ("one.png", "images.on: 'one.png' names one picture for 3 rows"),
        ("'odd/*.png'", "images.on: 'odd/*.png': it is not clear whether a10.png or a9.png comes"),
        ("/*.png", "images.on: '/*.png' is not a usable glob"),
    ],
)
def test_patterns_that_do_not_fit(tmp_path: Path, pattern: str, expected: str) -> None:
    for name in ("shots/1", "shots/2", "shots/3", "shots/4", "odd/a9", "odd/a10", "odd/a11"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((480, 640), np.uint8))
    (problem,) = problems_of(tmp_path, HEAD + f"images: {pattern}\n", NO_PIXELS)
    assert problem.startswith(f"capture.yaml:8: {expected}")


def test_one_picture_for_two_rows(tmp_path: Path) -> None:
    for name in ("table", "wall"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((480, 640), np.uint8))
    (problem,) = problems_of(tmp_path, HEAD + "images: '{plane}.png'\n", NO_PIXELS)
    assert problem.startswith("id 2: the picture") and problem.endswith("is already that of id 1")
