"""The HTML report: one file, escaped, labelled, true to its numbers, and shown by a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, find_chromium
from figure_cases import no_freedom, one_plane, two_cameras, usual, without_spots
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from markupsafe import Markup
from report_documents import document, empty_document
from scipy.spatial.transform import Rotation

from lasercal_gtsam.report.document import make_document
from lasercal_gtsam.report.html import render
from lasercal_gtsam.report.html.matrices import correlation_matrix
from lasercal_gtsam.report.html.numbers import (
    axis_ticks,
    chance,
    fixed,
    significant,
    tick_text,
)
from lasercal_gtsam.report.html.page import SECTIONS, _asset, _by_sigma, _pad
from lasercal_gtsam.report.html.palettes import CATEGORIES, sequential
from lasercal_gtsam.report.html.pictures import residual_histogram, residual_vectors
from lasercal_gtsam.report.html.planes import _rectangles, error_map, plane_coverage
from lasercal_gtsam.report.html.scene import EYE_DISTANCE, FILLING, NEAR, project
from lasercal_gtsam.report.html.svg import element

NASTY = (
    "<script>alert(1)</script>",
    '"><img src="http://example.invalid/x" onerror=alert(1)>',
    "</script><b>",
    "Tisch-\N{LATIN SMALL LETTER U WITH DIAERESIS} & 'Wand'",
)
MOST_BYTES, MOST_LOAD_S = 3_000_000, 1.0
BUSY = 8.0
"""How much slower than the promise a loaded machine may be in the default tests."""
VOID = {"meta", "link", "br", "input", "img", "hr"}


class Page(HTMLParser):
    """Elements of a page, and whether every one of them was closed where it belongs."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.faults: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        self.faults += [f"{tag} is not closed" for tag in self._open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        if len(set(names)) < len(names):
            self.faults.append(f"{tag} has an attribute twice: {names}")
        self.elements.append((tag, dict(attrs)))
        self.texts.setdefault(tag, [])
        if tag not in VOID:
            self._open.append(tag)
            self.texts[tag].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open.pop() != tag:
            self.faults.append(f"</{tag}> does not belong there, line {self.getpos()[0]}")

    def handle_data(self, data: str) -> None:
        if self._open:
            self.texts[self._open[-1]][-1] += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


MADE_UP = {
    "one camera": document(),
    "two cameras": document(cameras=("left", "right"), grade="weak"),
    "one plane": document(planes=("table",), grade="bad"),
    "100 000 spots": document(spots=100_000, binned=True),
    "nothing": empty_document(),
    "nasty names": document(cameras=NASTY[:2], planes=NASTY),
}


REAL = {
    f"real: {case.__name__}": case
    for case in (usual, one_plane, two_cameras, without_spots, no_freedom)
}
NAMES = (*MADE_UP, *REAL)


@cache
def content(name: str) -> dict[str, Any]:
    """A document made from formulas, or from a calibration as users get it."""
    return MADE_UP[name] if name in MADE_UP else make_document(REAL[name]())


@cache
def page_of(name: str) -> str:
    return render(content(name))


@pytest.fixture(params=NAMES, scope="module")
def named(request: pytest.FixtureRequest) -> tuple[dict[str, Any], Page, str]:
    text = page_of(request.param)
    return content(request.param), Page(text), text


def test_page_is_well_formed_and_its_links_lead_somewhere(named: Any) -> None:
    _, page, _ = named
    assert page.faults == []
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(set(ids)) == len(ids)
    wanted = [a["href"][1:] for a in page.of("a") if a["href"]]
    wanted += [
        a[key]
        for _, a in page.elements
        for key in ("aria-labelledby", "aria-describedby")
        if key in a
    ]
    assert wanted
    assert set(wanted) <= set(ids)


def test_page_has_every_section_in_the_order_of_the_questions(named: Any) -> None:
    made, page, text = named
    assert [text.count(f'id="{name}"') for name in SECTIONS] == [1] * len(SECTIONS)
    places = [text.index(f'id="{name}"') for name in SECTIONS]
    assert places == sorted(places)
    headings = [h.strip() for h in page.texts["h2"]]
    assert all(made[name]["heading"] in headings for name in SECTIONS if name != "verdict")


def test_nothing_is_loaded_and_no_other_script_can_run(named: Any) -> None:
    _, page, text = named
    for _, attributes in page.elements:
        for key in ("src", "href", "data", "action", "poster", "srcset", "xlink:href"):
            assert re.match(r"data:|#", attributes.get(key) or "#"), (key, attributes)
        assert not [name for name in attributes if name.startswith("on")]
    assert len(page.of("script")) == 2
    assert not page.of("img")
    policy = next(a["content"] for a in page.of("meta") if "http-equiv" in a)
    assert policy is not None
    assert "default-src 'none'" in policy
    assert "script-src 'sha256-" in policy
    style = page.texts["style"][0]
    assert "url(" not in style
    assert "@import" not in style
    # the only address in the file is the name of SVG, which nobody fetches, and what users wrote
    found = set(re.findall(r"https?://[^\s\"'<&]+", text.split("report-data")[0]))
    assert all(
        address == "http://www.w3.org/2000/svg"
        or "http://example.invalid/x".startswith(address.rstrip("…"))
        for address in found
    )


def test_the_data_in_the_page_are_the_document(named: Any) -> None:
    made, page, _ = named
    held = json.loads(page.texts["script"][0])
    plain = json.loads(json.dumps(made))
    for rows in (plain["rejected"]["outliers"], plain["rejected"]["rows"]):
        for row in rows:
            row["thumbnail"] = None  # the picture itself is in the page
    assert held == plain


def test_every_figure_is_named_and_described(named: Any) -> None:
    made, page, _ = named
    figures = [a for a in page.of("svg") if "drawing" in (a.get("class") or "")]
    assert bool(figures) == bool(made["scene"]["primitives"])
    for attributes in figures:
        assert attributes["role"] == "img"
        assert len(attributes["aria-label"] or "") > 10
    # what is neither named nor in a table beside its numbers must be hidden from readers
    for attributes in page.of("svg"):
        nested = {"x", "y", "width", "height"} <= attributes.keys() and "class" not in attributes
        assert nested or attributes.get("aria-label") or attributes.get("aria-hidden") == "true"
    for attributes in page.of("canvas"):
        assert attributes["tabindex"] == "0"
        assert made["scene"]["alt"] in (attributes["aria-label"] or "")
    for attributes in page.of("th"):
        assert attributes["scope"] in ("col", "row", "colgroup", "rowgroup")


def test_page_is_small_and_the_same_every_time(named: Any) -> None:
    made, _, text = named
    assert len(text.encode()) < MOST_BYTES
    assert render(made) == text


def test_names_of_users_are_text() -> None:
    page = Page(render(document(cameras=NASTY[:2], planes=NASTY)))
    shown = " ".join(t for texts in page.texts.values() for t in texts)
    assert all(f"plane {name}" in shown for name in NASTY)
    assert not [t for t in page.texts["script"] if "alert(1)" in t and "report" not in t]
    assert element("text", "<b>", title='"x"') == '<text title="&#34;x&#34;">&lt;b&gt;</text>'


def test_arrows_begin_at_the_spot_and_are_as_long_as_stated() -> None:
    image = document(spots=1, planes=("1",))["residuals"]["images"][0]
    image["spots"] |= {"u": [100.0], "v": [200.0], "du": [0.2], "dv": [-0.1]}
    page = Page(str(residual_vectors(image)))
    frame = next(a for a in page.of("rect") if a.get("class") == "frame")
    x, y, width, height = (float(frame[k] or 0) for k in ("x", "y", "width", "height"))
    assert height / width == pytest.approx(480 / 640, abs=1e-4)
    d = next(a["d"] for a in page.of("path") if a.get("class") == "arrow part-0")
    (u0, v0), (u1, v1) = re.findall(r"([\d.]+) ([\d.]+)", d or "")[:2]
    per_px = width / 640
    # pixel (0, 0) is the centre of the top-left pixel, so that the edge is at -0.5
    np.testing.assert_allclose(
        np.array([u0, v0], float), [x + 100.5 * per_px, y + 200.5 * per_px], atol=0.01
    )
    step = np.array([float(u1) - float(u0), float(v1) - float(v0)])
    np.testing.assert_allclose(step, np.array([0.2, -0.1]) * 150 * per_px, atol=0.02)
    key = next(a["d"] for a in page.of("path") if a.get("class") == "arrow key")
    (k0, _), (k1, _) = re.findall(r"([\d.]+) ([\d.]+)", key or "")[:2]
    assert float(k1) - float(k0) == pytest.approx(0.2 * 150 * per_px, abs=0.02)


def test_many_arrows_share_a_path_and_their_means_are_named() -> None:
    image = document(spots=100_000, binned=True)["residuals"]["images"][0]
    page = Page(str(residual_vectors(image)))
    classes = [a.get("class") for a in page.of("path")]
    assert classes.count("arrow part-0 faint") == 1
    assert classes.count("arrow mean") == 48 + 1  # and the one in the legend


def test_exact_data_have_a_histogram_too() -> None:
    histogram = document()["residuals"]["histograms"][0]
    exact = {**histogram, "edges_px": [0.0] * 21, "curve": None, "expected": None}
    text = residual_histogram(exact)
    assert "nan" not in text
    assert text.count('class="bar"') == 20


def test_bars_are_as_high_as_their_counts() -> None:
    histogram = document()["residuals"]["histograms"][0]
    bars = [a for a in Page(str(residual_histogram(histogram))).of("rect") if a["class"] == "bar"]
    heights = np.array([float(a["height"] or 0) for a in bars])
    counts = np.array(histogram["counts"], float)
    np.testing.assert_allclose(heights / heights.max(), counts / counts.max(), atol=1e-4)


@given(arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_rectangles_cover_a_mask_and_nothing_twice(mask: Any) -> None:
    covered = np.zeros(mask.shape, int)
    for left, top, right, bottom in _rectangles(mask):
        covered[top:bottom, left:right] += 1
    np.testing.assert_array_equal(covered, mask)


def test_map_shows_each_cell_in_the_colour_of_its_error() -> None:
    chart = document()["error_maps"]["maps"][0]
    page = Page(str(error_map(chart, 0)))
    frame = [a for a in page.of("rect") if a.get("class") == "frame"][-1]
    left, top, wide, high = (float(frame[k] or 0) for k in ("x", "y", "width", "height"))
    values = np.array(chart["error_mm"], float)
    rows, columns = values.shape
    seen = np.full(values.shape, "", dtype=object)
    x = left + (np.arange(columns) + 0.5) / columns * wide
    y = top + high - (np.arange(rows) + 0.5) / rows * high
    for path in page.of("path"):
        if path.get("shape-rendering"):
            for a, b, c, d in re.findall(r"M([\d.]+) ([\d.]+)H([\d.]+)V([\d.]+)", path["d"] or ""):
                x0, x1, y0, y1 = float(a), float(c), float(d), float(b)
                across = (x > min(x0, x1)) & (x < max(x0, x1))
                down = (y > min(y0, y1)) & (y < max(y0, y1))
                seen[np.ix_(down, across)] = path["fill"]
    known = np.isfinite(values)
    share = (values[known] - chart["scale_mm"][0]) / np.ptp(chart["scale_mm"])
    colours = sequential((np.minimum(np.floor(share * 32), 31) + 0.5) / 32)
    np.testing.assert_array_equal(seen[known], colours)
    assert set(seen[~known]) == {""}


def test_plane_figures_survive_spots_in_a_row_or_none() -> None:
    plane = document()["coverage"]["planes"][0]
    none: dict[str, list[float]] = {"x_mm": [], "y_mm": []}
    row = {"x_mm": [0.0, 50.0, 100.0], "y_mm": [5.0, 5.0, 5.0]}
    for spots in (none, row, {"x_mm": [3.0], "y_mm": [4.0]}):
        bare = {**plane, "spots": spots, "views": [], "hull_mm": [], "rejected": none}
        text = plane_coverage(bare, 0)
        assert "nan" not in text
        assert "inf" not in text


def test_correlations_are_in_their_cells_and_big_matrices_stay_small() -> None:
    correlation = document()["correlation"]
    rng = np.random.default_rng(0)
    matrix = np.eye(3)
    matrix[1, 0] = matrix[0, 1] = -0.75
    small = {**correlation, "names": ["a", "b", "c"], "matrix": matrix.tolist()}
    page = Page(str(correlation_matrix(small)))
    cell = next(a for a in page.of("rect") if a["class"] == "minus")
    assert float(cell["fill-opacity"] or 0) == pytest.approx(0.75)
    assert "a and b" not in str(correlation_matrix(small))
    assert "b and a: \N{MINUS SIGN}0.750" in str(correlation_matrix(small))
    n = 200
    root = rng.normal(size=(n, n))
    cov = root @ root.T
    scale = np.sqrt(np.diag(cov))
    big = {
        **correlation,
        "names": [f"name_{k}" for k in range(n)],
        "matrix": (cov / np.outer(scale, scale)).tolist(),
    }
    assert len(correlation_matrix(big)) < 700_000


def test_scene_is_projected_as_by_a_rotation() -> None:
    scene = {
        "centre": [0.3, -0.2, 0.5],
        "radius": 2.0,
        "view": {"azimuth_deg": 35.0, "elevation_deg": 20.0},
    }
    points = np.random.default_rng(1).normal(size=(20, 3))
    # turn the eye's direction onto x, then y is right and z up
    turn = Rotation.from_euler("ZY", [35.0, -20.0], degrees=True).inv()
    depth, right, up = turn.apply(points - scene["centre"]).T
    flat, near = project(points, scene)
    eye = 4.5 * 2.0
    np.testing.assert_allclose(near, depth, atol=1e-12)
    np.testing.assert_allclose(
        flat, np.column_stack([right, -up]) * (eye / (eye - depth))[:, None], atol=1e-12
    )


def test_both_drawings_of_the_scene_share_their_constants() -> None:
    stated = re.search(
        r"EYE_DISTANCE = ([\d.]+), FILLING = ([\d.]+), NEAR = ([\d.]+);", _asset("viewer.js")
    )
    assert stated is not None
    assert tuple(map(float, stated.groups())) == (EYE_DISTANCE, FILLING, NEAR)


def test_table_ends_with_the_rms() -> None:
    text = page_of("one camera")
    table = text[text.index('id="parameters"') : text.index('id="rejected"')]
    assert re.search(r">RMS</th>.*?>0\.1639</td>", table, re.S)


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(c <= 0.03928, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(a: str, b: str) -> float:
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_have_contrast(scheme: str) -> None:
    blocks = re.findall(r":root \{(.*?)\}", _asset("report.css"), re.S)
    light, dark = (dict(re.findall(r"--([\w-]+): (#\w{6})", block)) for block in blocks[:2])
    c = light if scheme == "light" else light | dark
    for text in ("ink", "soft", "link"):
        for ground in ("paper", "panel", "good-tint", "weak-tint", "bad-tint", "note-tint"):
            assert contrast(c[text], c[ground]) >= 4.5, (text, ground)
    for grade in ("good", "weak", "bad", "note"):
        assert contrast(c[grade], c[f"{grade}-tint"]) >= 4.5, grade
        assert contrast(c[grade], c["paper"]) >= 4.5, grade
    marks = [f"part-{k}" for k in range(CATEGORIES)]
    marks += ["axis-x", "axis-y", "axis-z", "scene-laser", "scene-ellipsoid", "plus", "minus"]
    for mark in marks:
        assert contrast(c[mark], c["paper"]) >= 3.0, mark


def test_sequential_colours_darken_evenly_for_every_eye() -> None:
    colours = sequential(np.linspace(0, 1, 33))
    light = np.array([luminance(c) for c in colours])
    assert np.all(np.diff(light) < 0)
    lightness = 116 * np.cbrt(light) - 16
    steps = -np.diff(lightness)
    assert steps.max() < 3 * steps.min()
    assert lightness[0] - lightness[-1] > 75


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 9))
def test_ticks_are_round_and_inside(low: float, size: float, count: int) -> None:
    ticks = axis_ticks(low, low + size, count)
    assert 1 <= len(ticks) <= 3 * count + 1
    slack = 1e-6 * size + 1e-9 * abs(low)
    assert all(low - slack <= t <= low + size + slack for t in ticks)
    if size > 1e-6 * abs(low) and len(ticks) > 1:
        assert len({tick_text(t, ticks) for t in ticks}) == len(ticks)
        steps = np.diff(ticks)
        np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


def test_numbers_are_printed_by_their_sigma() -> None:
    assert [_by_sigma(1.0, s) for s in (0.0123, 3.4, None)] == ["1.000", "1.0", "1.0000"]
    assert fixed(0.5, 1, sign=True) == "+0.5"
    assert fixed(-0.0001, 2) == "0.00"
    assert fixed(-1.5, 1) == "\N{MINUS SIGN}1.5"
    assert fixed(None, 2) == fixed(np.nan, 2) == significant(None) == ""
    assert [significant(v) for v in (0.0, 1.0, 12345.0, 0.00123, 1e-9)] == [
        "0", "1.00", "12345", "0.00123", "1.00\N{MULTIPLICATION SIGN}10⁻⁹",
    ]  # fmt: skip
    assert [chance(p) for p in (1e-7, 0.034, 1.0, None)] == ["< 0.0001", "0.034", "1.0", ""]


def test_numbers_line_up_on_the_decimal_point() -> None:
    def lacking(text: str) -> tuple[int, int]:
        pad = re.search(r"--pad:(\d+)", _pad(text, 3))
        return int(pad[1]) if pad else 0, "--point" in _pad(text, 3)

    assert [lacking(t) for t in ("1.234", "-20.5", "7", "held", "", "0.00012")] == [
        (0, False), (2, False), (3, True), (0, False), (0, False), (0, False),
    ]  # fmt: skip
    assert isinstance(_pad("1.2", 3), Markup)


# --- in a browser -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    program = find_chromium()
    if program is None:
        pytest.skip("there is no Chromium here")
    with Browser(program) as opened:
        yield opened


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("report")
    paths = {name: folder / f"{name.replace(':', '')}.html" for name in NAMES}
    for name, path in paths.items():
        path.write_text(page_of(name), encoding="utf-8")
    return paths


PICTURE = """
    new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => {
      const c = document.querySelector('canvas');
      const p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
      let ink = 0, sum = 0;
      for (let i = 3; i < p.length; i += 4) {
        if (p[i]) { ink++; sum = (sum * 31 + i + p[i - 1]) % 1e9; }
      }
      done([ink, sum]);
    })))
"""


@pytest.mark.parametrize("name", NAMES)
def test_browser_shows_the_page_without_asking_for_anything(
    browser: Browser, pages: dict[str, Path], name: str
) -> None:
    browser.open(pages[name])
    assert browser.evaluate("document.documentElement.classList.contains('js')")
    asked = [
        e["params"]["request"]["url"]
        for e in browser.events
        if e["method"] == "Network.requestWillBeSent"
    ]
    assert [url for url in asked if not url.startswith("data:")] == [pages[name].as_uri()]
    assert [
        e
        for e in browser.events
        if e["method"] in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled")
    ] == []
    assert browser.evaluate("""
      [...document.querySelectorAll('svg.drawing:not(.scene)')].filter(f => {
        const b = f.getBBox(), r = f.getBoundingClientRect();
        return !(b.width > 20 && b.height > 20 && r.width > 20 && r.height > 20
          && f.querySelectorAll('path, rect').length > 1);
      }).map(f => f.getAttribute('aria-label'))""") == []  # fmt: skip
    if content(name)["scene"]["primitives"]:
        assert browser.evaluate(PICTURE)[0] > 1000
        assert not browser.evaluate("!!(document.createElement('canvas').getContext('webgl'))"), (
            "the test should be without WebGL"
        )


def test_browser_loads_the_page_at_once(browser: Browser, pages: dict[str, Path]) -> None:
    times = []
    for _ in range(3):
        browser.open(pages["real: two_cameras"])
        times.append(
            browser.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd") / 1000
        )
    assert min(times) < BUSY * MOST_LOAD_S


def test_cell_is_turned_moved_and_peeled_by_keyboard(
    browser: Browser, pages: dict[str, Path]
) -> None:
    browser.open(pages["one camera"])
    # reached by the keyboard alone
    browser.evaluate("document.querySelector('#scene a, #weak-heading')?.scrollIntoView()")
    for _ in range(80):
        browser.press("Tab")
        if browser.evaluate("document.activeElement.tagName") == "CANVAS":
            break
    else:
        pytest.fail("Tab does not come to the cell")
    start = browser.evaluate(PICTURE)
    shown = [start]
    for key, modifiers in (("ArrowLeft", 0), ("ArrowUp", 8), ("+", 0), ("3", 0)):
        browser.press(key, modifiers)
        shown.append(browser.evaluate(PICTURE))
    assert all(a != b for a, b in pairwise(shown))
    browser.press("0")
    assert browser.evaluate(PICTURE) == start
    browser.press("Escape")
    assert browser.evaluate("document.activeElement.tagName") != "CANVAS"
    browser.evaluate("document.querySelector('[data-layer=planes]').click()")
    bare = browser.evaluate(PICTURE)
    assert bare[0] < start[0]
    browser.evaluate("document.querySelector('[data-layer=beams]').click()")
    assert browser.evaluate(PICTURE) != bare


@pytest.mark.parametrize("name", ["real: two_cameras", "nasty names", "nothing"])
def test_narrow_page_does_not_scroll_sideways(
    browser: Browser, pages: dict[str, Path], name: str
) -> None:
    narrow = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    browser.call("Emulation.setDeviceMetricsOverride", **narrow)
    try:
        browser.open(pages[name])
        browser.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        assert browser.evaluate("document.documentElement.scrollWidth") <= 360
        assert browser.evaluate("""
          [...document.querySelectorAll('main *, header *, nav *')].filter(e =>
            !e.closest('.scroll') && !e.closest('svg') && !e.closest('pre')
            && !e.closest('.unseen') && e.getBoundingClientRect().right > 361
          ).map(e => e.outerHTML.slice(0, 80))""") == []  # fmt: skip
    finally:
        browser.call("Emulation.clearDeviceMetricsOverride")


def test_dark_screen_is_dark_and_paper_is_white(browser: Browser, pages: dict[str, Path]) -> None:
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    try:
        browser.call("Emulation.setEmulatedMedia", features=dark)
        browser.open(pages["one camera"])
        before = browser.evaluate(PICTURE)
        assert sum(map(int, re.findall(r"\d+", browser.evaluate(ground)))) < 150
        browser.call("Emulation.setEmulatedMedia", features=[])
        assert browser.evaluate(ground) == "rgb(255, 255, 255)"
        assert browser.evaluate(PICTURE) != before, "the canvas follows the theme"
        browser.call("Emulation.setEmulatedMedia", media="print", features=dark)
        assert browser.evaluate(ground) == "rgb(255, 255, 255)"
        shown = "getComputedStyle(document.querySelector('{}')).display"
        assert browser.evaluate(shown.format("canvas")) == "none"
        assert browser.evaluate(shown.format(".still")) == "block"
        assert browser.evaluate(shown.format("nav")) == "none"
    finally:
        browser.call("Emulation.setEmulatedMedia", media="", features=[])


def test_print_holds_what_the_screen_folds_away(browser: Browser, pages: dict[str, Path]) -> None:
    browser.open(pages["one camera"])
    folded = "[...document.querySelectorAll('details *')].filter(e => e.checkVisibility()).length"
    before = browser.evaluate(folded)
    try:
        browser.call("Emulation.setEmulatedMedia", media="print")
        assert browser.evaluate(folded) > before + 20
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
    pdf = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
    assert pdf.startswith("JVBERi0"), "a PDF"


def test_without_script_the_cell_is_a_drawing(browser: Browser, pages: dict[str, Path]) -> None:
    try:
        browser.call("Emulation.setScriptExecutionDisabled", value=True)
        browser.open(pages["one camera"])
        # the debugger may look, though the page may not run
        heights = [
            browser.evaluate(f"document.querySelector('{what}').getBoundingClientRect().height")
            for what in (".still svg", "canvas", ".tools")
        ]
        assert heights[0] > 200
        assert heights[1:] == [0, 0]
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)


def test_what_is_copied_has_a_plain_minus(browser: Browser, pages: dict[str, Path]) -> None:
    browser.open(pages["one camera"])
    assert browser.evaluate("document.body.innerText.includes('\\u2212')")
    copied = browser.evaluate("""(() => {
      let text = null;
      const data = new DataTransfer(), event = new ClipboardEvent('copy', { clipboardData: data });
      getSelection().selectAllChildren(document.getElementById('rejected'));
      document.dispatchEvent(event);
      return data.getData('text/plain');
    })()""")
    assert "(4.50, -3.25)" in copied
    assert "\N{MINUS SIGN}" not in copied
