"""The report's content: complete, plain, small, and the numbers of the calibration itself."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from figure_cases import no_freedom, one_plane, two_cameras, usual, without_spots
from scipy.stats import norm, t

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import SpotResults
from lasercal_gtsam.io.calibration_file import to_dict
from lasercal_gtsam.report.document import make_document
from lasercal_gtsam.report.material import Origin
from lasercal_gtsam.report.table import interval_factor
from lasercal_gtsam.report.words import size_words

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
SECTIONS = (
    "verdict", "parameters", "rejected", "residuals", "levels", "coverage", "error_maps",
    "correlation", "weak", "scene", "model_error", "conventions", "inputs",
)  # fmt: skip
CASES = [usual, one_plane, two_cameras, without_spots, no_freedom]


def made(calibration: lc.Calibration, **given: Any) -> dict[str, Any]:
    return make_document(calibration, created=NOW, **given)


@cache
def document_of(case: Callable[[], lc.Calibration]) -> dict[str, Any]:
    return made(case())


def leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from leaves(item)
    else:
        yield value


@pytest.mark.parametrize("case", CASES)
def test_the_document_is_plain_and_complete(case):
    document = document_of(case)
    text = json.dumps(document, allow_nan=False)
    assert json.loads(text) == document
    assert len(text) < 1_000_000
    assert {type(leaf) for leaf in leaves(document)} <= {str, int, float, bool, type(None)}
    assert list(document)[6:] == list(SECTIONS)  # in the order in which it is asked
    for name in SECTIONS:
        section = document[name]
        assert section["heading"]
        assert isinstance(section["words"], list)
        assert section["missing"] is None or section["missing"].endswith(".")
    for figure in figures(document):
        assert figure["alt"].endswith(".")
        assert "nan" not in figure["alt"].split() + figure["caption"].split()


def figures(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        *document["residuals"]["images"],
        *document["residuals"]["histograms"],
        *document["coverage"]["images"],
        *document["coverage"]["planes"],
        *document["error_maps"]["maps"],
        document["correlation"],
        document["scene"],
    ]


def test_the_same_calibration_gives_the_same_document():
    assert made(usual()) == document_of(usual)
    loaded = json.loads(json.dumps(to_dict(usual())))
    assert loaded["parameters"][0]["refined"] == pytest.approx(
        document_of(usual)["parameters"]["rows"][0]["refined"], rel=1e-11
    )


# --- verdict and parameters --------------------------------------------------------------------


def test_the_verdict_is_that_of_judge():
    document = document_of(two_cameras)
    verdict = lc.judge(two_cameras(), halves=True)
    assert document["verdict"]["grade"] == verdict.grade
    assert document["verdict"]["next_action"] == verdict.next_action
    assert [r["words"] for r in document["verdict"]["reasons"]] == [
        reason.words for reason in verdict.reasons
    ]


def test_without_spots_there_is_a_reason_and_no_failure():
    document = document_of(without_spots)
    assert document["verdict"]["grade"] == "weak"
    assert document["verdict"]["reasons"][0]["code"] == "no-spots"
    for name in ("residuals", "coverage", "levels"):
        assert "does not hold its spots" in document[name]["missing"]
    assert document["error_maps"]["maps"]
    assert document["summary"]["expected_error_mm"] == []  # nobody knows where the spots were
    assert document["parameters"]["rows"][0]["sigma"] is not None


@pytest.mark.parametrize("case", CASES)
def test_rows_are_the_tables(case):
    found = case()
    document = document_of(case)["parameters"]
    factor = t.ppf(0.975, found.fit.dof) if found.fit.dof >= 1 else np.nan
    assert [row["name"] for row in document["rows"]] == [p.name for p in found.parameters]
    for row, p in zip(document["rows"], found.parameters, strict=True):
        assert row["refined"] == pytest.approx(p.refined, rel=1e-11)
        assert row["unit"] == p.unit
        assert row["held"] == (p.sigma == 0)
        if p.sigma > 0:
            assert row["high"] - row["low"] == pytest.approx(2 * factor * p.sigma, rel=1e-5)
            assert row["text"]["low"]
        else:
            assert row["low"] is row["high"] is None
            assert row["text"]["low"] == ""
            assert row["text"]["sigma"] == ("held" if p.sigma == 0 else "unknown")


def test_rows_name_their_part_and_frame():
    rows = {row["name"]: row for row in document_of(two_cameras)["parameters"]["rows"]}
    assert rows["left.fu"]["part"] == "camera 'left'"
    assert rows["right.Tz"]["part"] == "camera 'right'"
    assert (rows["right.Tz"]["frame"], rows["right.Tz"]["unit"]) == ("base", "mm")
    assert (rows["red.laser_phi"]["part"], rows["red.laser_phi"]["frame"]) == (
        "laser 'red'",
        "hand",
    )
    assert "x = 0" in rows["red.laser_y"]["meaning"]
    assert (rows["a_3_z"]["part"], rows["a_3_z"]["frame"]) == ("plane '3'", "base")


def test_intervals_are_students_and_normal_where_that_is_the_same():
    assert interval_factor(4) == (pytest.approx(t.ppf(0.975, 4)), "t")
    assert interval_factor(1e6) == (pytest.approx(norm.ppf(0.975)), "normal")
    assert np.isnan(interval_factor(0)[0])
    assert document_of(no_freedom)["parameters"]["interval"]["factor"] is None


def test_intervals_from_elsewhere_take_the_place_of_those_by_sigma():
    found = one_plane()
    given = {p.name: (p.refined - 1.0, p.refined + 2.0) for p in found.parameters if p.sigma > 0}
    given["k2"] = (-np.inf, found["k2"].refined + 2.0)
    section = made(found, intervals=given)["parameters"]
    assert section["interval"]["distribution"] == "likelihood"
    assert section["interval"]["factor"] is None
    rows = {row["name"]: row for row in section["rows"]}
    assert rows["fu"]["high"] - rows["fu"]["low"] == pytest.approx(3.0)
    assert rows["k2"]["low"] is None
    assert rows["k2"]["text"]["low"] == "no bound"
    assert rows["u0"]["text"]["low"] == ""  # held


def test_an_interval_holds_the_truth_as_often_as_it_says():
    """Few degrees of freedom, where the normal distribution would hold it 92 times in 100."""
    from lasercal_gtsam.simulate import simulate

    base = simulate("paper", 4)
    seen = base.observations[np.r_[0:4, 10:14, 30:34, 40:44]]
    options = lc.CalibrationOptions(
        robust="none", fixed=("intrinsics", "T_base_camera", "laser:laser")
    )
    rng = np.random.default_rng(0)
    held = []
    for _ in range(150):
        uv = seen.uv + 0.05 * rng.standard_normal(seen.uv.shape)
        found = lc.calibrate(replace(seen, uv=uv), initial=base.truth, options=options)
        factor, _ = interval_factor(found.fit.dof)
        held += [
            abs(p.refined - p.initial) < factor * p.sigma for p in found.parameters if p.sigma > 0
        ]
    assert 0.92 < np.mean(held) < 0.98


# --- what was left out -------------------------------------------------------------------------


def test_outliers_are_told_with_their_reason_the_worst_first():
    found = two_cameras()
    section = document_of(two_cameras)["rejected"]
    rejected = {s.id: s for s in found.spots if s.rejected}
    assert section["outliers_total"] == len(rejected) == found.fit.n_rejected
    assert [o["id"] for o in section["outliers"]] == sorted(
        rejected, key=lambda name: -np.hypot(*rejected[name].residual_px)
    )
    assert all(o["why"] == rejected[o["id"]].rejected for o in section["outliers"])
    assert section["rows_total"] is None
    assert section["pictures"] == "The capture is not at hand, so there are no pictures."
    assert document_of(usual)["rejected"]["missing"] == "Nothing."
    assert document_of(usual)["rejected"]["pictures"] is None


# --- figures -----------------------------------------------------------------------------------


def test_figures_say_what_they_show():
    document = document_of(two_cameras)
    (left, right) = document["residuals"]["images"]
    assert (left["camera"], right["camera"]) == ("left", "right")
    assert f"{left['magnification']:g} times" in left["caption"]
    spots = left["spots"]
    assert len(spots["id"]) == len(spots["u"]) == len(spots["plane"]) == left["shown"]
    assert len(document["error_maps"]["maps"]) == 6
    for one in document["error_maps"]["maps"]:
        ny, nx = len(one["y_mm"]), len(one["x_mm"])
        grids = [one["error_mm"], one["inside"], one["split"]["error_mm"]]
        assert all(len(grid) == ny and all(len(row) == nx for row in grid) for grid in grids)
        assert one["levels_mm"] == [c["level_mm"] for c in one["contours"]]
        assert 0 < one["scale_mm"][0] < one["scale_mm"][1]
        assert size_words(one["largest_mm"]) in one["alt"]
    layers = {layer["name"]: layer for layer in document["scene"]["layers"]}
    assert layers["camera-uncertainty"]["magnification"] > 1
    assert {p["layer"] for p in document["scene"]["primitives"]} == set(layers)


def test_halves_that_cannot_be_calibrated_are_told():
    document = document_of(no_freedom)
    assert document["levels"]["halves"] is None
    assert document["error_maps"]["missing"].startswith("There are no degrees of freedom")
    assert document["correlation"]["missing"]
    assert document["correlation"]["matrix"] == []


def test_very_many_spots_make_no_larger_document():
    base = usual()
    rng = np.random.default_rng(0)
    rows = np.sort(rng.integers(0, len(base.inputs.observations), 12_000))
    seen = base.inputs.observations[rows]
    seen = replace(seen, uv=seen.uv + 0.01 * rng.standard_normal(seen.uv.shape))
    names = np.array([f"s{k}" for k in range(len(rows))])
    seen = replace(seen, id=names)
    spots = SpotResults(
        names, seen.plane, seen.camera, seen.laser, base.spots.residual_px[rows],
        np.ones(len(rows)), (None,) * len(rows),
    )  # fmt: skip
    many = replace(base, spots=spots, inputs=replace(base.inputs, observations=seen))
    document = made(many)
    assert len(json.dumps(document)) < 1_000_000
    (image,) = document["residuals"]["images"]
    assert image["total"] == 12_000
    assert image["shown"] == len(image["spots"]["u"]) == 1500
    assert "1500 of 12000" in image["caption"]
    assert sum(image["bins"]["count"]) == 12_000
    assert any("sample of 2000 of" in words for words in document["levels"]["words"])
    assert "sample" in {reason["code"] for reason in document["verdict"]["reasons"]}


# --- weak, model error, inputs -----------------------------------------------------------------


def test_what_is_held_and_weak_is_in_words():
    section = document_of(one_plane)["weak"]
    assert section["held"] == list(one_plane().observability.held)
    assert section["missing"] is None
    for direction in section["directions"]:
        assert direction["what"]
        assert direction["cure"]


def test_model_errors_are_named_and_those_that_show_are_found():
    from opinion_cases import calibrated

    names = [item["name"] for item in document_of(usual)["model_error"]["items"]]
    assert {"bent plane", "lens beyond the model", "robot's kinematics"} <= set(names)
    moved = made(calibrated("paper", 2, "moved"))
    items = {item["name"]: item for item in moved["model_error"]["items"]}
    assert items["plane moved"]["sought"]["found"]
    assert items["plane moved"]["sought"]["words"].startswith("Found: plane '3' moved")
    assert not items["lens beyond the model"]["sought"]["found"]
    assert items["scale"]["sought"] is None  # no spot can show it
    good = {item["name"]: item["sought"] for item in document_of(usual)["model_error"]["items"]}
    assert not any(sought["found"] for sought in good.values() if sought)


def test_inputs_repeat_the_run(tmp_path):
    found = usual()
    path = tmp_path / "calibration.json"
    found.save(path)
    origin = Origin.of_file(path)
    section = made(found, origin=origin)["inputs"]
    written = json.loads(path.read_text())["provenance"]
    assert section["inputs_sha256"] == written["sha256"]
    assert section["calibrated"] == written["created"]
    assert section["calibration"]["name"] == "calibration.json"
    assert {"python", "gtsam", "numpy", "lasercal-gtsam"} <= set(section["versions"])
    (again,) = [c["command"] for c in section["commands"] if c["command"].startswith("import")]
    space: dict[str, Any] = {}
    exec(again.replace("'calibration.json'", repr(str(path))), space)
    again_found = space["again"]
    # from the closed form instead of from the truth: the same optimum
    assert again_found.fit.rms_px == pytest.approx(found.fit.rms_px, rel=1e-9)


def test_the_command_has_the_options_that_were_given():
    options = lc.CalibrationOptions(
        distortion=("k1",), robust="none", known={"principal_point": (320.0, 240.0)}, sigma_px=0.3
    )
    seen = usual().inputs.observations
    found = lc.calibrate(seen, initial=usual().cell, options=options)
    origin = Origin(files={"my cell.yaml": "00", "poses.csv": "11"})
    section = made(found, origin=origin)["inputs"]
    assert section["commands"][0]["command"] == (
        "lasercal calibrate 'my cell.yaml' --distortion k1 --robust none --sigma-px 0.3 "
        "--known principal_point=320.0,240.0 -o calibration.json"
    )
    values = {option["name"]: option["value"] for option in section["options"]}
    assert values["known"] == "principal_point = 320, 240"
    assert values["priors"] == "none"


# --- pictures ----------------------------------------------------------------------------------


def picture_of(thumbnail: dict[str, Any]) -> np.ndarray:
    head, _, content = thumbnail["data"].partition(",")
    assert head == "data:image/png;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (thumbnail["height"], thumbnail["width"])
    return image


@pytest.fixture(scope="module")
def with_pictures(tmp_path_factory):
    """A capture of pictures: one shows the spot of another pose, one no spot."""
    from lasercal_gtsam.simulate import simulate, write_simulation
    from lasercal_gtsam.simulate.pictures import PictureOptions

    folder = tmp_path_factory.mktemp("pictures")
    made_ = simulate("paper", 1, shots=4)
    write_simulation(folder, made_, spots=False, pictures=PictureOptions())
    images = folder / "images"
    names = sorted(p.stem for p in images.glob("*.png") if not p.stem.endswith("_off"))
    wrong, other, dark = names[2], names[20], names[30]
    for end in ("", "_off"):
        a, b = images / f"{wrong}{end}.png", images / f"{other}{end}.png"
        first = a.read_bytes()
        a.write_bytes(b.read_bytes())
        b.write_bytes(first)
    (images / f"{dark}.png").write_bytes((images / f"{dark}_off.png").read_bytes())
    capture = lc.load_capture(folder)
    account = capture.detections()
    found = lc.calibrate(capture.observations(account=account), options=capture.options())
    return capture, account, found, {wrong, other}, dark


def test_thumbnails_show_the_spot_that_was_left_out(with_pictures):
    capture, account, found, swapped, dark = with_pictures
    section = made(found, capture=capture, account=account)["rejected"]
    assert swapped <= {o["id"] for o in section["outliers"]}
    for outlier in section["outliers"]:
        thumbnail = outlier["thumbnail"]
        image = picture_of(thumbnail)
        x, y = thumbnail["seen"]
        bright = np.unravel_index(np.argmax(cv2.blur(image, (3, 3))), image.shape)
        assert np.hypot(bright[1] - x, bright[0] - y) < 4
        np.testing.assert_allclose(
            np.add(thumbnail["corner_uv"], thumbnail["seen"]), outlier["uv"], atol=0.01
        )
        away = np.subtract(thumbnail["predicted"], thumbnail["seen"])
        np.testing.assert_allclose(away, outlier["residual_px"], atol=0.02)
    assert section["pictures"] is None
    rows = {row["id"]: row for row in section["rows"]}
    assert section["rows_total"] == len(rows) == sum(not usable for usable in account.usable)
    assert rows[dark]["verdict"] == "none"
    assert rows[dark]["thumbnail"]["scale"] == 0.25
    assert picture_of(rows[dark]["thumbnail"]).shape == (120, 160)


def test_without_an_account_rows_are_told_all_the_same(with_pictures):
    capture, _, found, _, dark = with_pictures
    section = made(found, capture=capture)["rejected"]
    assert dark in {row["id"] for row in section["rows"]}


def test_a_picture_that_is_gone_is_told(with_pictures):
    capture, account, found, swapped, _ = with_pictures
    name = sorted(swapped)[0]
    path = capture.images_on[capture.ids.tolist().index(name)]
    content = path.read_bytes()
    path.unlink()
    try:
        section = made(found, capture=capture, account=account)["rejected"]
    finally:
        path.write_bytes(content)
    assert "could not be read" in section["pictures"]
    (gone,) = [o for o in section["outliers"] if o["id"] == name]
    assert gone["thumbnail"] is None
