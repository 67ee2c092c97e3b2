"""Figures for papers: they draw the figures' own numbers, on anybody's axes, and touch nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import figure_cases as cases
import matplotlib
import numpy as np
import pytest
from cli_support import Cli
from matplotlib.figure import Figure

import lasercal_gtsam as lc
from lasercal_gtsam.figures import correlation, error_map, image_coverages, residual_fields
from lasercal_gtsam.plot import KINDS, SUFFIXES
from lasercal_gtsam.plot.files import figure_of, save_figure


def test_residual_arrows_are_the_residuals_times_what_is_stated() -> None:
    calibration = cases.usual()
    field = residual_fields(calibration)[0]
    ax = calibration.plot.residuals()
    quivers = [c for c in ax.collections if hasattr(c, "U")]
    assert sum(len(q.U) for q in quivers) == field.total == 90
    drawn = np.concatenate([np.column_stack([q.X, q.Y, q.U, q.V]) for q in quivers])
    residual = calibration.spots.residual_px
    seen = calibration.inputs.observations.uv
    wanted = np.column_stack([seen, field.magnification * residual])
    key = lambda rows: rows[np.lexsort(rows.T)]  # noqa: E731
    np.testing.assert_allclose(key(drawn), key(wanted), atol=1e-9)
    said = [text.get_text() for text in ax.texts]
    stated = f"{field.reference_px:.3g} px (arrows {field.magnification:g} times as long)"
    assert any(stated in text for text in said)
    assert ax.get_xlim() == (-0.5, 639.5) and ax.get_ylim() == (479.5, -0.5)
    assert ax.get_aspect() == 1.0


def test_the_map_is_the_error_map() -> None:
    calibration = cases.usual()
    found = error_map(calibration, "2")
    ax = calibration.plot.error_map("2")
    (image,) = ax.images
    np.testing.assert_array_equal(image.get_array().filled(np.nan), found.error_mm)
    left, right, bottom, top = image.get_extent()
    columns = np.linspace(left, right, 2 * len(found.x_mm) + 1)[1::2]
    np.testing.assert_allclose(columns, found.x_mm)
    rows = np.linspace(bottom, top, 2 * len(found.y_mm) + 1)[1::2]
    np.testing.assert_allclose(rows, found.y_mm)
    ax.figure.draw_without_rendering()
    levels = {f"{contour.level_mm:g} mm" for contour in found.contours}
    labels = {text.get_text() for text in ax.texts}
    assert labels and labels <= levels
    assert ax.get_aspect() == 1.0 and "(mm)" in ax.get_xlabel()
    bars = [other for other in ax.figure.axes if other is not ax]
    assert [bar.get_ylabel() for bar in bars] == ["expected error (mm)"]


def test_coverage_of_picture_and_plane() -> None:
    calibration = cases.usual()
    found = image_coverages(calibration)[0]
    ax = calibration.plot.coverage()
    spots = sum(len(line.get_xdata()) for line in ax.lines if line.get_label().startswith("plane"))
    assert spots == found.total
    assert f"{100 * found.hull_share:.0f} %" in ax.get_title()
    plane = calibration.plot.coverage(plane="1")
    assert "plane 1" in plane.get_title() and plane.get_aspect() == 1.0
    with pytest.raises(lc.DataError, match="not both"):
        calibration.plot.coverage("camera", plane="1")


def test_correlation_is_the_matrix() -> None:
    calibration = cases.usual()
    ax = calibration.plot.correlation()
    np.testing.assert_array_equal(ax.images[0].get_array(), correlation(calibration).matrix)
    assert [t.get_text() for t in ax.get_yticklabels()] == list(correlation(calibration).names)


def test_the_cell_has_equal_axes() -> None:
    ax = cases.usual().plot.cell()
    ax.figure.draw_without_rendering()
    spans = [np.ptp(getattr(ax, f"get_{axis}lim")()) for axis in "xyz"]
    shape = ax._box_aspect  # what is drawn per axis
    np.testing.assert_allclose(shape / shape[0], np.array(spans) / spans[0], rtol=1e-9)
    words = " ".join(text.get_text() for text in ax.get_legend().get_texts())
    assert "uncertainty of cameras (x " in words


def test_given_axes_are_drawn_on_and_returned() -> None:
    figure = Figure()
    left, right = figure.subplots(1, 2)
    plot = cases.two_cameras().plot
    assert plot.residuals("left", ax=left) is left
    assert plot.error_map("1", "right", ax=right) is right
    space = Figure().add_subplot(projection="3d")
    assert plot.cell(ax=space) is space
    with pytest.raises(lc.DataError, match="projection='3d'"):
        plot.cell(ax=left)


def test_names_must_be_given_where_there_are_several() -> None:
    plot = cases.two_cameras().plot
    with pytest.raises(lc.DataError, match="left, right; none was named"):
        plot.residuals()
    with pytest.raises(lc.DataError, match="'middle' is not among them"):
        plot.coverage("middle")
    with pytest.raises(lc.DataError, match="plane: the cell has 1, 2, 3"):
        plot.error_map(camera="left")


def test_nothing_to_draw_is_said() -> None:
    for draw in (cases.without_spots().plot.residuals, cases.without_spots().plot.coverage):
        with pytest.raises(lc.DataError, match="nothing to draw"):
            draw()
    with pytest.raises(lc.DataError, match="sigmas"):
        cases.no_freedom().plot.error_map("1")
    with pytest.raises(lc.DataError, match="nothing to draw"):
        figure_of(cases.no_freedom(), "error-map")


def test_matplotlib_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(lc.DataError, match=r"lasercal-gtsam\[report\]"):
        cases.usual().plot.residuals()


def test_no_setting_is_touched_and_bytes_repeat(tmp_path: Path) -> None:
    # asking for the backend would choose one
    names = [name for name in matplotlib.rcParams if name != "backend"]
    before = {name: matplotlib.rcParams[name] for name in names}
    pages = []
    for name in ("a", "b"):
        for suffix in (".svg", ".pdf"):
            save_figure(figure_of(cases.usual(), "residuals"), tmp_path / f"{name}{suffix}")
        pages.append([(tmp_path / f"{name}{s}").read_bytes() for s in (".svg", ".pdf")])
    assert pages[0] == pages[1]
    assert {name: matplotlib.rcParams[name] for name in names} == before
    assert "matplotlib.pyplot" not in sys.modules


def test_the_command_draws_every_kind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cli = Cli(capsys)
    path = tmp_path / "c.json"
    cases.usual().save(path)
    done = cli("plot", path, "all", "-o", tmp_path / "fig.svg")
    assert done.status == 0, done.err
    for kind in KINDS:
        text = (tmp_path / f"fig-{kind}.svg").read_text()
        assert text.startswith("<?xml") and f"fig-{kind}.svg" in done.out
    assert set(SUFFIXES) == {".png", ".svg", ".pdf"}
    done = cli("plot", path, "cell", "-o", tmp_path / "x.jpg")
    assert done.status == 1 and ".png, .svg, .pdf" in done.err
    cases.without_spots().save(path)
    done = cli("plot", path, "residuals", "-o", tmp_path / "y.png")
    assert done.status == 1 and "nothing to draw" in done.err
