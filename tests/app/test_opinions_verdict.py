"""The verdict: no false alarms, the right grade where something is wrong, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_support import Cli
from opinion_cases import PIXELS, calibrated, capture

import lasercal_gtsam as lc
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.presets import PRESETS
from lasercal_gtsam.simulate.simulation import simulate

# what the geometry alone may say of a good capture
GEOMETRY = {"fold", "weak-geometry", "coverage"}


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


def preset_calibration(preset, seed):
    made = simulate(preset, seed, PRESETS[preset].noise)
    options = lc.CalibrationOptions(known=made.known)
    return lc.calibrate(made.observations, initial=made.truth, options=options)


def no_false_alarm(preset, seed):
    verdict = lc.judge(preset_calibration(preset, seed), halves=True)
    codes = {r.code for r in verdict.reasons if r.severity != "note"}
    assert verdict.grade != "bad", (preset, seed, verdict.reasons)
    assert codes <= GEOMETRY, (preset, seed, verdict.reasons)
    assert (verdict.grade == "good") == (not codes)


@pytest.mark.parametrize("preset", ["paper", "table2-3", "tool-z-2"])
def test_good_captures_are_not_called_bad(preset):
    for seed in range(100, 106):
        no_false_alarm(preset, seed)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "table2-3", "tool-z-2"])
def test_good_captures_are_never_called_bad(preset):
    for seed in range(50):
        no_false_alarm(preset, seed)


@pytest.mark.parametrize(
    ("preset", "fault", "code"),
    [
        ("table2-3", "scale-z", "robot-scale"),
        ("table2-3", "joint", "robot-orientation"),
        ("paper", "fisheye", "camera-lens"),
        ("tool-z-2", "orientations", "robot-orientation"),
    ],
)
def test_a_fault_that_dominates_is_bad_and_named_first(preset, fault, code):
    verdict = lc.judge(calibrated(preset, 1, fault))
    assert verdict.grade == "bad"
    assert verdict.reasons[0].code == code
    assert verdict.next_action == verdict.reasons[0].action
    assert "times less" in verdict.reasons[0].words


def test_a_plane_that_moved_is_told_by_how_much_and_since_when():
    verdict = lc.judge(calibrated("tool-z-2", 1, "moved"))
    first = next(r for r in verdict.reasons if r.code == "plane-moved")
    assert first.words.startswith(("plane '2' moved by 1.9 mm", "plane '2' moved by 2"))
    assert "before spot 's041'" in first.words
    assert verdict.grade != "good"


def test_a_group_left_out_as_a_whole_is_said():
    calibration = calibrated("paper", 1)
    spots = calibration.spots
    out = np.arange(90) < 10
    rejected = tuple("far off" if x else None for x in out)
    mixed = replace(
        calibration,
        spots=replace(spots, weight=np.where(out, 0.0, 1.0), rejected=rejected),
        fit=replace(calibration.fit, n_spots=80, n_rejected=10),
    )
    verdict = lc.judge(mixed)
    assert verdict.grade == "weak"
    assert {"rejected", "group-rejected"} <= {r.code for r in verdict.reasons}
    assert any("10 of the 10 shots" in r.words for r in verdict.reasons)


def test_what_the_fit_itself_says_counts():
    calibration = calibrated("paper", 1)

    def codes(**changes):
        verdict = lc.judge(replace(calibration, fit=replace(calibration.fit, **changes)))
        return verdict.grade, *(r.code for r in verdict.reasons[:1])

    assert codes() == ("good",)
    assert codes(converged=False, status="not converged: no") == ("bad", "not-converged")
    assert codes(n_rejected=60) == ("bad", "rejected")
    assert codes(sigma0=float("nan"), dof=0.0) == ("bad", "unchecked")
    assert codes(rms_px=20.0) == ("bad", "far")
    assert codes(dof=10.0) == ("weak", "few-spots")


def test_noise_is_held_against_what_was_stated():
    wrong = lc.judge(calibrated("paper", 1, sigma_px=0.08))
    assert wrong.grade == "bad"
    assert wrong.reasons[0].code == "noise"
    assert lc.judge(calibrated("paper", 1, sigma_px=0.16)).grade == "weak"
    assert lc.judge(calibrated("paper", 1, sigma_px=0.3)).grade == "good"
    generous = lc.judge(calibrated("paper", 1, sigma_px=1.0))
    assert generous.grade == "good"
    assert "quiet" in {r.code for r in generous.reasons}


def test_exact_data_are_not_judged_by_their_rounding():
    verdict = lc.judge(calibrated("paper", 1, noise=Noise()))
    assert verdict.grade == "good"
    assert [r.code for r in verdict.reasons if r.code == "exact"] == ["exact"]
    assert verdict.opinions.findings == ()


def test_spots_in_a_corner_of_the_picture_are_weak():
    seen, made = capture("tool-z-2", 0)
    size = {"camera": (4 * 640, 4 * 480)}
    large = {"camera": replace(made.truth.cameras["camera"], image_size=size["camera"])}
    start = replace(made.truth, cameras=large)
    options = lc.CalibrationOptions(distortion="none")
    result = lc.calibrate(replace(seen, image_size=size), initial=start, options=options)
    verdict = lc.judge(result)
    assert verdict.grade == "weak"
    assert [r.code for r in verdict.reasons if r.severity == "weak"] == ["coverage"]


def test_weak_geometry_is_weak_and_says_what_is_not_determined():
    seen, made = capture("tool-z-2", 0, noise=Noise(pixel_px=4.0))
    options = lc.CalibrationOptions(distortion="none")
    verdict = lc.judge(lc.calibrate(seen, initial=made.truth, options=options))
    assert verdict.grade == "weak"
    weak = [r for r in verdict.reasons if r.severity == "weak"]
    assert {r.code for r in weak} == {"weak-geometry"}
    assert "hardly determined: " in weak[0].words


@pytest.mark.parametrize("preset", ["paper-1", "no-groups", "table2-1"])
def test_every_kind_of_capture_can_be_judged(preset):
    verdict = lc.judge(preset_calibration(preset, 1), halves=True)
    assert verdict.grade in ("good", "weak")


def test_two_cameras_and_two_lasers_can_be_judged():
    seen, made = capture("paper", 1)
    camera, beam = made.truth.cameras["camera"], made.truth.lasers["laser"]
    other, _ = capture("paper", 2)
    truth = lc.Cell(
        {"left": camera, "right": camera}, {"red": beam, "green": beam}, made.truth.planes
    )
    parts = []
    for k, (spots, name, laser) in enumerate(((seen, "left", "red"), (other, "right", "green"))):
        uv = lc.project(
            truth, spots.T_base_hand, plane=spots.plane.tolist(), camera=name, laser=laser
        )
        good = np.isfinite(uv).all(axis=1)
        noise = PIXELS.pixel_px * np.random.default_rng(k).standard_normal(uv.shape)
        parts.append(
            Observations.from_arrays(
                (uv + noise)[good],
                spots.T_base_hand[good],
                plane=spots.plane[good].tolist(),
                image_size=camera.image_size,
                camera=name,
                laser=laser,
                id=[f"{name}{i}" for i in range(int(good.sum()))],
            )
        )
    result = lc.calibrate(parts[0] + parts[1], initial=truth)
    verdict = lc.judge(result, halves=True)
    assert verdict.grade != "bad", verdict.reasons
    kinds = {(p.kind, p.name) for p in verdict.opinions.levels[-1].parts}
    assert {("camera", "left"), ("camera", "right")} <= kinds


@pytest.mark.parametrize(
    "stated", [{"hand_sigma_m": 1e-4}, {"hand_sigma_m": 1e-3, "sigma_px": 0.3}]
)
def test_stated_robot_noise_is_no_fault_of_the_robot(stated):
    """The likeliest hand poses follow the residuals: no suspect may take that for evidence."""
    noise = Noise(0.3, stated["hand_sigma_m"])
    for seed in range(1, 4):
        seen, made = capture("paper", seed, noise=noise)
        result = lc.calibrate(seen, initial=made.truth, options=lc.CalibrationOptions(**stated))
        verdict = lc.judge(result)
        assert {r.code for r in verdict.reasons if r.severity != "note"} <= GEOMETRY


def test_a_robust_loss_can_be_judged():
    seen, made = capture("table2-3", 1)
    options = lc.CalibrationOptions(robust="huber")
    verdict = lc.judge(lc.calibrate(seen, initial=made.truth, options=options), halves=True)
    assert verdict.grade != "bad", verdict.reasons


def test_the_verdict_survives_saving(tmp_path: Path):
    calibration = calibrated("table2-3", 1, "scale-z")
    calibration.save(tmp_path / "calibration.json")
    again = lc.judge(lc.load_calibration(tmp_path / "calibration.json"))
    once = lc.judge(calibration)
    assert again.grade == once.grade
    assert [r.code for r in again.reasons] == [r.code for r in once.reasons]


def test_the_command_prints_the_verdict_first(cli, tmp_path: Path):
    calibrated("table2-3", 1).save(tmp_path / "good.json")
    outcome = cli("judge", tmp_path / "good.json")
    assert outcome.status == 0, outcome.err
    assert outcome.out.startswith("Verdict: good. Use it.")
    for words in ("let off", "Faults looked for", "Two halves", "Tests of the residuals", "mm"):
        assert words in outcome.out
    assert outcome.err == ""


def test_the_command_fails_on_a_bad_calibration_and_answers_in_json(cli, tmp_path: Path):
    calibrated("table2-3", 1, "scale-z").save(tmp_path / "bad.json")
    outcome = cli("judge", tmp_path / "bad.json", "--json")
    assert outcome.status == 1
    document = json.loads(outcome.out)
    assert document["verdict"] == "bad"
    assert document["reasons"][0]["code"] == "robot-scale"
    assert len(document["opinions"]["split"]["rows"]) == 25
    assert document["opinions"]["levels"][-1]["name"] == "full"


def test_the_command_says_what_it_cannot_read(cli, tmp_path: Path):
    outcome = cli("judge", tmp_path / "none.json")
    assert outcome.status == 1
    assert outcome.err.startswith("Error: ")
