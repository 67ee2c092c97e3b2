"""The studies: errors as the paper counts them, statistics, findings; the same from any engine."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from cli_support import Cli

import lasercal_gtsam as lc
from lasercal_gtsam.cli.console import _seldom
from lasercal_gtsam.engine import OneProcess, Processes
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate.cells import paper_cell
from lasercal_gtsam.study import StudyCell, fig6, fig7, table2
from lasercal_gtsam.study.errors import relative_errors
from lasercal_gtsam.study.fig6_runs import (
    HAND_NOISE,
    METHODS,
    PAPER_CLOSED,
    REFINED,
    REFINED_FROM_PAPER,
    trial_seed,
)
from lasercal_gtsam.study.findings import Finding, fig6_findings, table2_findings
from lasercal_gtsam.study.laser import FORMS, closed_form
from lasercal_gtsam.study.outcome import ErrorCurves
from lasercal_gtsam.study.page import page_of
from lasercal_gtsam.study.printed import PRINTED_SIGMAS
from lasercal_gtsam.study.table2_runs import TestColumn as Column
from lasercal_gtsam.study.table2_runs import test_columns as columns_of


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


FAST = [m for m in METHODS if m.startswith(("M2", "M3", "M4"))]


@pytest.fixture(scope="module")
def exact():
    """Two trials without noise, all methods."""
    return fig6(trials=2, levels=(0.0,))


def test_every_method_returns_the_truth_without_noise(exact):
    curves = exact.curves["fig6"]
    assert curves.methods == METHODS
    assert curves.asked.all()
    assert curves.errors.shape == (1, len(METHODS), 2, 3)
    assert np.nanmax(curves.errors) < 1e-8
    assert not np.isnan(curves.errors).any()


@pytest.mark.parametrize("form", FORMS)
def test_each_closed_form_is_exact_by_itself(form):
    made = StudyCell("paper").simulated(5, lc_noise(0.0))
    cell = closed_form(form, made.observations)
    assert cell.cameras["camera"].intrinsics.fu == pytest.approx(550.0, rel=1e-8)
    np.testing.assert_allclose(
        cell.cameras["camera"].T_base_camera, made.truth.cameras["camera"].T_base_camera, atol=1e-8
    )


def lc_noise(level):
    from lasercal_gtsam.simulate import Noise

    return Noise.table1(level)


def test_errors_are_those_of_section_4_1():
    T0 = make_pose(np.eye(3), np.array([0.3, -0.4, 0.0]))
    angle = 0.02
    T = make_pose(rotation_exp(np.array([0.0, 0.0, angle])), np.array([0.3, -0.4, 0.01]))
    fu, R, t = relative_errors(561.0, T, 550.0, T0)
    assert fu == pytest.approx(0.02)
    # |R - 1|_F = 2 sqrt(2) sin(angle/2)
    assert pytest.approx(2 * np.sqrt(2) * np.sin(angle / 2) / np.sqrt(3)) == R
    assert t == pytest.approx(0.01 / 0.5)
    assert relative_errors(900.0, T, 550.0, T0) is None
    assert relative_errors(float("nan"), T, 550.0, T0) is None


def curves_of(values, methods=("A", "B"), at=(1.0,)):
    """Curves from f_u errors (X, M, N); NaN is a failure."""
    values = np.asarray(values, dtype=float)
    errors = np.repeat(values[..., None], 3, axis=-1)
    asked = np.ones(values.shape[:2], dtype=bool)
    return ErrorCurves("x", "noise level", tuple(at), tuple(methods), errors, asked)


def test_statistics_leave_failures_out_of_the_mean_but_not_of_the_median():
    nan = np.nan
    curves = curves_of([[[0.01, 0.02, 0.03, nan], [0.5, nan, nan, nan]]])
    np.testing.assert_allclose(curves.mean[0, :, 0], [0.02, 0.5])
    assert curves.median[0, 0, 0] == pytest.approx(0.025)
    assert np.isinf(curves.median[0, 1, 0])
    assert curves.failures.tolist() == [[1, 3]]
    assert curves.standard_error[0, 0, 0] == pytest.approx(0.01 / np.sqrt(3))
    text = curves.table("f_u")
    assert "2/2.5 (1)" in text
    assert "50/inf (3)" in text


def test_findings_say_yes_no_and_too_few():
    rng = np.random.default_rng(0)
    levels = (0.2, 0.4, 0.6, 0.8, 1.0)
    # REFINED as the reference says, exactly: yes. HAND_NOISE worse than it: no
    means = np.array([0.269, 0.528, 0.718, 0.949, 1.27]) / 100
    good = means[:, None] * np.array([0.9, 1.0, 1.1])
    curves = curves_of(np.stack([good, 1.5 * good], axis=1), (REFINED, HAND_NOISE), levels)
    found = {f.claim: f for f in fig6_findings(curves)}
    noise = found["modelling the robot's noise improves the laser method"]
    assert noise.holds is False
    assert "ahead at 0 of 15 points" in noise.evidence
    assert "error 1.50 to 1.50 times" in noise.evidence
    # f_u within the reference, R and T (set equal to f_u) not: no
    assert found["M1 refined: means within 15 % of the reference"].holds is False
    wild = np.abs(rng.standard_normal((5, 1, 3))) * 0.01
    few = [f for f in fig6_findings(curves_of(wild, (REFINED,), levels)) if "reference" in f.claim]
    assert few[0].holds in (False, None)
    assert isinstance(few[0], Finding)


def test_trial_seeds_are_those_of_spawned_sequences():
    children = np.random.SeedSequence(42).spawn(4)
    assert trial_seed(42, 3) == int(children[3].generate_state(1, np.uint64)[0])


def test_levels_of_a_trial_share_cell_and_motions():
    a, b = (StudyCell().simulated(7, lc_noise(level)) for level in (0.2, 1.0))
    np.testing.assert_array_equal(a.observations.T_base_hand, b.observations.T_base_hand)
    assert a.truth == b.truth


def test_the_digest_does_not_depend_on_the_engine_or_the_number_of_levels(tmp_path):
    settings = {"trials": 3, "levels": (0.4, 1.0), "methods": FAST, "seed": 3}
    alone = fig6(**settings, workers=OneProcess())
    workers = Processes(2)
    together = fig6(**settings, workers=workers, journal=tmp_path / "j")
    assert alone.results.digest == together.results.digest
    other = fig6(trials=3, levels=(1.0,), methods=FAST, seed=3)
    np.testing.assert_array_equal(other.curves["fig6"].errors[0], alone.curves["fig6"].errors[1])
    again = fig6(**settings, workers=workers, journal=tmp_path / "j")
    assert (again.results.resumed, again.results.executed) == (6, 0)
    assert again.results.digest == alone.results.digest


def test_fig7_runs_whole_groups_only_and_the_papers_chain_on_several_planes_only():
    study = fig7(trials=1, samples=(30, 60))
    assert {name: c.at for name, c in study.curves.items()} == {
        "1 plane (a_1)": (30, 60),
        "1 plane (a_2)": (30, 60),
        "2 planes": (60,),
        "3 planes": (30, 60),
    }
    paper = study.curves["1 plane (a_1)"].row("M1 paper's closed form")
    assert not study.curves["1 plane (a_1)"].asked[:, paper].any()
    assert study.curves["2 planes"].asked.all()
    exact = fig7(trials=1, samples=(60,), pixel_px=0.0)
    for curves in exact.curves.values():
        assert np.nanmax(np.where(curves.asked[..., None, None], curves.errors, 0)) < 1e-8


def test_table2_columns():
    study = table2(trials=2, tests=("Test 2", "Test 4"))
    two, four = study.columns
    assert two.names[:3] == ("fu", "fv", "alpha_c")
    assert len(four.names) == 25
    i = four.names.index("fu")
    assert abs(four.refined[i] - four.truth[i]) < 6 * four.sigma[i]
    assert four.printed[i] == 25.9
    assert np.isnan(two.printed[two.names.index("alpha_c")])
    assert 1.8 < four.median_rms_px < 3.2
    text = study.table()
    assert "Test 4: 2 captures, 0 without an answer" in text
    assert text.count("RMS") == 2


def test_table2_counts_what_gave_no_answer():
    spec = {"tests": {"Test 4": {}}}
    run_ = {"rows": {"fu": [900.0, None, 905.0, 5.0]}, "rms_px": 2.5}
    (column,) = columns_of(spec, [run_, {"failed": "because"}, run_])
    assert column.failed == ("because",)
    assert column.captures == 3
    assert np.isnan(column.initial[0])
    (nothing,) = columns_of(spec, [{"failed": "because"}])
    assert nothing.names == ()


def test_angles_of_table2_differ_by_less_than_half_a_turn():
    spec = {"tests": {"Test 4": {}}}
    runs = [
        {"rows": {"theta": [179.9, 180.0, value, 0.1]}, "rms_px": 1.0} for value in (-179.9, 179.7)
    ]
    (column,) = columns_of(spec, runs)
    assert column.spread[0] == pytest.approx(np.std([0.2, -0.2], ddof=1))


def test_an_own_cell_takes_the_place_of_the_papers():
    own = paper_cell(2)
    wide = replace(
        own.cameras["camera"], intrinsics=replace(own.cameras["camera"].intrinsics, fu=500.0)
    )
    cell = replace(own, cameras={"camera": wide})
    said = StudyCell(cell=cell, groups=2, planes=("1", "2"))
    assert StudyCell.from_plain(json.loads(json.dumps(said.to_plain()))) == said
    study = fig6(trials=1, levels=(0.0,), cell=said, methods=[REFINED])
    assert study.curves["fig6"].errors.max() < 1e-8
    with pytest.raises(DataError, match="2 cameras and 1 lasers"):
        StudyCell(cell=replace(own, cameras={"a": wide, "b": wide}))


def test_another_cell_is_not_held_against_the_papers_numbers():
    settings = {"trials": 2, "levels": (1.0,), "methods": [*FAST, REFINED]}
    papers = fig6(**settings)
    other = fig6(**settings, cell=StudyCell(design="near"))
    assert papers.as_paper
    assert not other.as_paper
    assert any("reference" in f.claim for f in papers.findings)
    assert not any("reference" in f.claim for f in other.findings)
    assert "Cell, motions or noise are not the paper" in page_of(other, "x")
    assert "Cell, motions or noise are not the paper" not in page_of(papers, "x")
    assert not fig7(trials=1, samples=(60,), pixel_px=0.5).as_paper
    assert not table2(trials=1, tests=("Test 4",), design="near").as_paper


def test_one_plane_is_studied_without_the_chain_that_needs_several():
    study = fig6(trials=1, levels=(0.0,), cell=StudyCell("paper", planes=("1",)))
    curves = study.curves["fig6"]
    left_out = {m for m, was in zip(METHODS, curves.asked[0], strict=True) if not was}
    assert left_out == {PAPER_CLOSED, REFINED_FROM_PAPER}
    assert not curves.failures.any()
    assert study.findings[0].holds is True


def test_a_view_too_narrow_is_the_users_to_mend(monkeypatch):
    monkeypatch.setattr("lasercal_gtsam.study.captures._MAX_TRIES", 20)
    own = paper_cell(2)
    camera = own.cameras["camera"]
    narrow = replace(camera, intrinsics=replace(camera.intrinsics, fu=9e4, fv=9e4))
    cell = StudyCell(cell=replace(own, cameras={"camera": narrow}))
    with pytest.raises(DataError, match=r"no motions for Ma's method .* Leave the method out"):
        fig6(trials=1, levels=(0.0,), cell=cell, methods=["M2 Ma"])


def test_behind_by_less_than_the_scatter_is_too_few_trials_to_say():
    errors = np.array([[[0.010, 0.014, 0.012], [0.011, 0.010, 0.013]]])
    claim = "modelling the robot's noise improves the laser method"

    def holds(values):
        found = fig6_findings(curves_of(values, (HAND_NOISE, REFINED)), as_paper=False)
        return next(f for f in found if f.claim == claim).holds

    assert holds(errors) is None
    assert holds(errors[:, ::-1]) is True
    assert holds(errors * np.array([[[2.0], [1.0]]])) is False
    failed = errors.copy()
    failed[0, 0] = np.nan
    assert holds(failed) is False


def test_nothing_is_claimed_of_methods_that_were_not_run():
    few = fig6_findings(curves_of([[[0.01, 0.02], [0.03, 0.04]]], (REFINED, "M2 Ma")))
    claims = [f.claim for f in few if "reference" not in f.claim]
    assert claims == ["the refined laser method is ahead of Ma's closed form"]


def test_a_reason_covers_a_row_so_far_only():
    def finding(ratios):
        names = tuple(ratios)
        printed = tuple(PRINTED_SIGMAS["Test 4"][n] for n in names)
        sigma = tuple(p * r for p, r in zip(printed, ratios.values(), strict=True))
        column = Column("Test 4", names, *([sigma] * 6), printed, 2.5, 2.5, captures=1, failed=())
        return table2_findings([column])[0]

    assert finding({"fu": 1.0, "Tz": 0.15, "a_2_x": 3.0}).holds is True
    for name, ratio in (("fu", 2.5), ("Tz", 2.5), ("Tz", 0.05), ("a_2_x", 5.0), ("Ty", 0.1)):
        found = finding({"a_2_y": 1.0, name: ratio})
        assert found.holds is False
        assert f"{name} {ratio:.2f}" in found.evidence


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trials": 0}, "trials: expected an integer >= 1, got 0"),
        ({"seed": -1}, "seed: expected an integer >= 0, got -1"),
        ({"levels": ()}, "levels: expected numbers >= 0"),
        ({"levels": (0.2, 0.2)}, "the same number twice"),
        ({"methods": ["M5"]}, "method 'M5' is unknown"),
        ({"methods": []}, "no method is left"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(DataError, match=message):
        fig6(**{"trials": 1, "levels": (0.0,), **settings})


def test_wrong_settings_of_the_others_are_refused():
    with pytest.raises(DataError, match="expected multiples of 10 times the number of planes"):
        fig7(trials=1, samples=(7,))
    with pytest.raises(DataError, match="plane '9' is not in the cell, which has 1, 2"):
        StudyCell("paper-2", planes=("9",))
    with pytest.raises(DataError, match="groups: expected an integer >= 1, got 0"):
        StudyCell(groups=0)
    with pytest.raises(DataError, match="no test is left"):
        table2(trials=1, tests=())
    with pytest.raises(DataError, match="test 'Test 9' is unknown"):
        table2(trials=1, tests=("Test 9",))


def test_the_public_name():
    assert lc.study.fig6 is fig6


def test_the_command_writes_everything_and_goes_on_where_it_stopped(tmp_path, cli):
    out = tmp_path / "out"
    args = ["study", "fig6", "--levels", "0.5,1", "--methods", "M2,M4", "-j", "1", "-o", str(out)]
    first = cli(*args, "--trials", "2")
    assert first.status == 0, first.err
    assert "M2 Ma" in first.out
    assert "M1" not in first.out.split("What agrees")[0]
    names = {p.name for p in out.iterdir()}
    assert names >= {"fig6.txt", "fig6.json", "fig6.csv", "fig6.html", "fig6.journal"}
    document = json.loads((out / "fig6.json").read_text())
    assert document["format"] == "lasercal-study"
    assert len(document["runs"]) == 4
    with (out / "fig6.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 2 * 4 * 3
    assert float(rows[0]["mean"]) == pytest.approx(document["statistics"][0]["mean"])
    page = (out / "fig6.html").read_text()
    assert document["digest"] in page
    assert "<script" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    more = cli(*args, "--trials", "3", "--json")
    assert "4 runs were in" in more.err
    assert json.loads(more.out)["runs"][:4] == document["runs"]
    other = cli(*args[:3], "0.7", *args[4:], "--trials", "2")
    assert other.status == 1
    assert "holds the runs of another study (levels" in other.err


def test_the_figures_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    from lasercal_gtsam.study.plots import as_bytes, figure_of

    study = fig6(trials=2, levels=(0.5, 1.0), methods=FAST)
    figure = figure_of(study)
    assert [len(ax.get_legend_handles_labels()[1]) for ax in figure.axes] == [6, 6, 6]
    assert as_bytes(figure, "png")[:4] == b"\x89PNG"
    assert b"<svg" in as_bytes(figure, "svg")
    assert len(figure_of(table2(trials=1, tests=("Test 4",))).axes) == 1
    assert len(figure_of(fig7(trials=1, samples=(60,))).axes) == 2


@pytest.mark.parametrize(
    ("args", "status", "message"),
    [
        (["fig6", "--levels", "a"], 2, "expected numbers between commas, got 'a'"),
        (["fig6", "--methods", "M7"], 2, "'--methods': 'M7' is not one of M1"),
        (["fig7", "--samples", "30.5"], 2, "expected whole numbers"),
        (["table2", "--tests", "5"], 2, "'--tests': '5' is not one of 1, 2, 3, 4"),
        (["fig6", "--jobs", "2", "--cluster", "tcp://a:1"], 1, "not both"),
        (["fig6", "--cell", "nothing.json"], 1, "nothing.json: there is no such file"),
        (["fig6", "--design", "wild"], 1, "motion design 'wild' is unknown"),
        (["fig6", "--planes", "7"], 1, "plane '7' is not in the cell, which has 1, 2, 3"),
        (["fig6", "--planes", "1,1"], 2, "expected names between commas, each once, got '1,1'"),
        (["table2", "--tests", ""], 2, "expected names between commas, each once"),
        (["fig7", "-o", "/dev/null/out"], 1, "/dev/null/out: cannot be a folder of results"),
    ],
)
def test_wrong_options_are_refused(args, status, message, cli):
    result = cli("study", *args)
    assert result.status == status
    assert message in result.err


def test_an_interruption_says_how_to_go_on(tmp_path, cli, monkeypatch):
    def interrupted(**settings):
        raise KeyboardInterrupt

    monkeypatch.setattr("lasercal_gtsam.study.fig6", interrupted)
    done = cli("study", "fig6", "-j", "1", "-o", tmp_path / "out")
    assert done.status == 130
    assert f"are in {tmp_path / 'out' / 'fig6.journal'}: the same command goes on" in done.err


def test_a_log_gets_a_line_a_minute(capsys):
    times = iter([0.0, 1.0, 30.0, 61.0, 90.0, 121.0, 181.0])
    show = _seldom("Runs", lambda: next(times))
    for done in (1, 50, 101, 150, 201, 300):
        show(done, 300)
    # 100 runs in the minute behind the first call, then 200 in two
    assert capsys.readouterr().err.splitlines() == [
        "Runs: 101 of 300, about 2 min left",
        "Runs: 201 of 300, about 1 min left",
    ]
