"""`lasercal compare`: what it prints, its JSON and its page."""

from __future__ import annotations

import re
from pathlib import Path

import compare_cases as cases
import figure_cases
import pytest
from browser import Browser, find_chromium
from cli_support import Cli

import lasercal_gtsam as lc
from lasercal_gtsam.report.comparison import FORMAT, comparison_document
from lasercal_gtsam.report.html.page import render_comparison


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "a.json", tmp_path / "b.json"
    cases.first().save(paths[0])
    cases.camera_moved().save(paths[1])
    return paths


def test_it_says_first_what_moved(cli: Cli, files: tuple[Path, Path]) -> None:
    done = cli("compare", *files)
    assert done.status == 0 and not done.err
    first, second = done.out.splitlines()[:2]
    assert re.match(r"Camera 'camera' moved by [45]\.\d+ \+- 0\.\d+ mm and 0\.\d+ \+- 0\.\d+ deg", first)  # fmt: skip  # noqa: E501
    assert second.startswith("Next: Use B for this camera")
    assert "90 in A, 90 in B, 0 in both" in done.out
    for words in ("lens of camera 'camera'", "a_3_z", "Millimetres between", "Pixels between"):
        assert words in done.out


def test_json_has_the_numbers_of_the_comparison(cli: Cli, files: tuple[Path, Path]) -> None:
    found = cli.json("compare", *files)
    assert found["format"] == FORMAT and found["verdict"] == "different"
    wanted = lc.compare(*(lc.load_calibration(path) for path in files))
    assert [row["name"] for row in found["rows"]] == [row.name for row in wanted.rows]
    assert found["rows"][0]["sigma"] == pytest.approx(wanted.rows[0].sigma, rel=1e-5)
    assert found["parts"][0]["shift_mm"] == pytest.approx(wanted.parts[0].shift_mm, rel=1e-5)
    assert {m["plane"] for m in found["plane_maps"]} == {"1", "2", "3"}


def test_the_page_needs_nothing_else(cli: Cli, files: tuple[Path, Path]) -> None:
    page = files[0].parent / "compare.html"
    done = cli("compare", *files, "-o", page)
    assert done.status == 0 and f"Saved {page}." in done.out
    text = page.read_text()
    assert text.startswith("<!DOCTYPE html>") and len(text) < 1_000_000
    assert not re.findall(r"(?:src|href)=[\"'](?!#|data:)", text) and "<script" not in text
    assert text.count("<svg") >= 6 and "Camera &#39;camera&#39; moved by" in text
    # a page is written over, anything else is left as it is
    assert cli("compare", *files, "-o", page).status == 0
    other = files[0].parent / "notes.txt"
    other.write_text("mine")
    refused = cli("compare", *files, "-o", other)
    assert refused.status == 1 and "not a page" in refused.err
    assert other.read_text() == "mine"


def test_names_on_the_page_are_escaped() -> None:
    found = lc.compare(cases.first(), cases.second())
    page = render_comparison(comparison_document(found, ("<b>a", "b&c")))
    assert "<b>a" not in page and "&lt;b&gt;a" in page


@pytest.mark.parametrize(
    "pair",
    [
        (figure_cases.no_freedom, figure_cases.usual),
        (figure_cases.without_spots, figure_cases.usual),
        (figure_cases.two_cameras, figure_cases.usual),
        (figure_cases.one_plane, figure_cases.usual),
        (figure_cases.two_cameras, figure_cases.two_cameras),
    ],
)
def test_every_odd_pair_has_a_page_and_lines(
    cli: Cli, tmp_path: Path, pair: tuple[object, object]
) -> None:
    paths = tmp_path / "a.json", tmp_path / "b.json"
    for path, make in zip(paths, pair, strict=True):
        make().save(path)  # type: ignore[operator]
    done = cli("compare", *paths, "-o", tmp_path)
    assert done.status == 0, done.err
    assert "nan" not in done.out
    assert "nan" not in (tmp_path / "compare.html").read_text().lower().replace("<!doctype", "")


def test_what_is_no_calibration_is_refused(cli: Cli, files: tuple[Path, Path]) -> None:
    other = files[0].with_name("c.json")
    other.write_text("{}")
    done = cli("compare", files[0], other)
    assert done.status == 1 and "not a calibration" in done.err


@pytest.mark.skipif(find_chromium() is None, reason="there is no Chromium")
def test_the_page_opens_without_a_complaint(files: tuple[Path, Path]) -> None:
    from lasercal_gtsam.report.comparison import write_page

    page = files[0].parent / "compare.html"
    write_page(lc.compare(cases.first(), cases.camera_moved()), page, ("a", "b"))
    program = find_chromium()
    assert program is not None
    with Browser(program) as browser:
        browser.open(page)
        boxes = browser.evaluate(
            "[...document.querySelectorAll('figure > svg')].map(s => s.getBBox().width)"
        )
        assert len(boxes) == 6 and min(boxes) > 100
        asked = [
            e["params"]["request"]["url"]
            for e in browser.events
            if e["method"] == "Network.requestWillBeSent"
        ]
        assert [url for url in asked if not url.startswith("data:")] == [page.as_uri()]
        assert not [
            e
            for e in browser.events
            if e["method"] in ("Runtime.exceptionThrown", "Log.entryAdded")
        ]
