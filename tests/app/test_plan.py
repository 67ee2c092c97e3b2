"""Plans: in view, within the limits, as good as they promise, and written for the robot."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from cli_support import Cli

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Beam, Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import load_capture
from lasercal_gtsam.plan import Limits, limits_of, next_poses, plan, procedure
from lasercal_gtsam.plan.design import Problem, choose, covariance_of
from lasercal_gtsam.projection import spot_on_beam
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.simulate.cells import paper_cell, random_plane

CELL = paper_cell(2)
NOISE = Noise(pixel_px=1.0)


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def forty():
    return plan(CELL, 40)


def random_cell(seed: int) -> Cell:
    """The paper's camera before two random planes, with a random beam."""
    rng = np.random.default_rng([seed, 77])
    camera = paper_cell(1).cameras["camera"]
    u = rng.standard_normal(3)
    u[2] = abs(u[2]) + 1.0
    beam = Beam(u / np.linalg.norm(u), rng.uniform(-0.04, 0.04, 3))
    first = random_plane(camera, (), rng)
    second = random_plane(camera, (first,), rng)
    return Cell({"camera": camera}, {"laser": beam}, {"1": first, "2": second})


def test_every_spot_is_in_view_and_every_hand_within_the_limits():
    limits = Limits(
        margin_px=25.0,
        clearance=0.06,
        reach=(0.2, 0.75),
        box=((0.0, -0.4, 0.0), (0.8, 0.5, 0.9)),
        beam_length=(0.07, 0.2),
    )
    made = plan(CELL, 30, limits=limits, seed=3)
    assert len(made) == 30
    width, height = CELL.cameras["camera"].image_size
    seen = lc.project(CELL, made.T_base_hand, plane=made.plane.tolist())
    np.testing.assert_allclose(seen, made.uv)
    assert (seen >= 25.0 - 1e-6).all()
    assert (seen <= np.array([width, height]) - 26.0 + 1e-6).all()
    t = made.T_base_hand[:, :3, 3]
    assert (np.linalg.norm(t, axis=1) <= 0.75).all()
    assert (t >= [0.0, -0.4, 0.0]).all()
    assert (t <= [0.8, 0.5, 0.9]).all()
    spots = spot_on_beam(CELL, made.T_base_hand, plane=made.plane.tolist())
    q = made.T_base_hand[:, :3, :3] @ CELL.lasers["laser"].point_hand + t
    lengths = np.linalg.norm(spots - q, axis=1)
    assert lengths.min() >= 0.07 - 1e-9
    assert lengths.max() <= 0.2 + 1e-9
    centre = CELL.cameras["camera"].T_base_camera[:3, 3]
    for name, part in CELL.planes.items():
        side = np.sign(part.normal_base @ centre - part.distance)
        on = made.plane == name
        assert (side * (t[on] @ part.normal_base - part.distance) >= 0.06).all()


def grid_pixels(points):
    """Pixels at which the true camera of `CELL` sees points in the base, without distortion."""
    camera = CELL.cameras["camera"]
    p = (points - camera.T_base_camera[:3, 3]) @ camera.T_base_camera[:3, :3]
    return p[:, :2] / p[:, 2:] * 550.0 + [320.0, 240.0]


def test_the_promise_is_the_covariance_of_the_calibration_itself(forty):
    """Nearly exact spots at the planned poses: the same sigma of locate, scaled to one pixel."""
    rng = np.random.default_rng(4)
    seen = forty.observations()
    seen = replace(seen, uv=seen.uv + 1e-4 * rng.standard_normal(seen.uv.shape))
    found = lc.calibrate(seen, initial=CELL, options=lc.CalibrationOptions(robust="none"))
    problem = Problem.of(CELL, "camera", "laser", np.eye(25), Limits())
    for name, points in problem.places.items():
        _, cov = found.locate(grid_pixels(points), plane=name)
        rms = np.sqrt(np.mean(np.trace(cov, axis1=1, axis2=2))) / found.fit.sigma0
        # the plan adds the plausible ranges as a prior, which 40 spots outweigh
        assert rms == pytest.approx(forty.after[name], rel=0.02)


def test_the_plan_keeps_its_promise_in_simulation_and_needs_no_start(forty):
    rng = np.random.default_rng(0)
    seen = forty.observations()
    problem = Problem.of(CELL, "camera", "laser", np.eye(25), Limits())
    squares = {name: [] for name in CELL.planes}
    for _ in range(12):
        noisy = replace(seen, uv=seen.uv + rng.standard_normal(seen.uv.shape))
        found = lc.calibrate(noisy)
        assert found.fit.converged
        for name, points in problem.places.items():
            located, _ = found.locate(grid_pixels(points), plane=name)
            squares[name].append(np.mean(np.sum((located - points) ** 2, axis=1)))
    for name, values in squares.items():
        # a dozen runs know a root mean square to about a quarter
        assert np.sqrt(np.mean(values)) == pytest.approx(forty.after[name], rel=0.5)


@pytest.mark.parametrize("seed", range(4))
def test_forty_poses_beat_the_procedures_forty(seed):
    cell = random_cell(seed)
    ours, papers = plan(cell, 40, seed=seed), procedure(cell, 2, seed=seed)
    assert len(ours) == len(papers) == 40
    for name in cell.planes:
        assert ours.after[name] < 0.6 * papers.after[name]


def test_choosing_is_as_good_as_trying_all_pairs():
    """Against brute force on a problem small enough for it."""
    rng = np.random.default_rng(1)
    rows, weight = rng.standard_normal((9, 2, 4)), np.diag([1.0, 2.0, 0.5, 1.5])
    prior = np.eye(4) * 0.1
    chosen = choose(prior, rows, weight, 0.7, 3)

    def error(which):
        return np.trace(weight @ covariance_of(prior, rows[list(which)], 0.7))

    best = min(combinations(range(9), 3), key=error)
    assert error(chosen) <= 1.001 * error(best)
    J = rows[list(best)].reshape(-1, 4) / 0.7
    np.testing.assert_allclose(
        covariance_of(prior, rows[list(best)], 0.7), np.linalg.inv(prior + J.T @ J), rtol=1e-10
    )


def test_more_poses_promise_less_error_and_the_same_seed_the_same_plan(forty):
    few = plan(CELL, 25)
    assert all(few.after[name] > forty.after[name] for name in CELL.planes)
    assert plan(CELL, 25) == few
    assert plan(CELL, 25, seed=1) != few


def test_the_next_poses_help_most_where_the_calibration_is_weak():
    made = simulate("paper-2", 5, NOISE, groups=4)
    first = lc.calibrate(made.observations, initial=made.truth)
    more = next_poses(first, 6)
    promised = {name: more.after[name] / more.before[name] for name in more.after}
    assert all(ratio < 0.8 for ratio in promised.values())
    rng = np.random.default_rng(2)
    seen = more.observations("n")
    uv = lc.project(made.truth, seen.T_base_hand, plane=seen.plane.tolist())
    extra = replace(seen, uv=uv + rng.standard_normal(uv.shape))
    second = lc.calibrate(made.observations + extra, initial=made.truth)
    for name in more.after:
        problem = Problem.of(made.truth, "camera", "laser", np.eye(25), Limits())
        before, after = (
            np.sqrt(np.mean(problem.error_map(c.covariance / c.fit.sigma0**2)[name] ** 2))
            for c in (first, second)
        )
        assert 0.5 < after / before / promised[name] < 2.0


def test_next_keeps_what_is_held():
    made = simulate("paper-1", 1, NOISE)
    options = lc.CalibrationOptions(distortion="none", known=made.known)
    found = lc.calibrate(made.observations, options=options)
    more = next_poses(found, 2)
    assert set(more.plane) == {"1"}
    assert more.after["1"] < more.before["1"]


def test_next_counts_a_tied_aspect_ratio_as_known():
    """f_u and f_v are one unknown then: the promise is that of the covariance with both tied."""
    made = simulate("paper-2", 3, NOISE, groups=3)
    options = lc.CalibrationOptions(distortion="none", known={"aspect": 1.0, "skew": 0.0})
    found = lc.calibrate(made.observations, options=options)
    more = next_poses(found, 3)
    problem = Problem.of(found.cell, "camera", "laser", np.eye(25), Limits())
    rows = problem.rows(more.T_base_hand, more.plane)
    C = covariance_in(found, problem.labels)
    for J in rows.reshape(-1, 25):  # one equation after the other
        gain = C @ J / (J @ C @ J + more.sigma_px**2)
        C = C - np.outer(gain, J @ C)
    for name in more.after:
        expected = problem.mean_error(C)[name]
        assert more.after[name] == pytest.approx(expected, rel=1e-3)
        assert more.after[name] < more.before[name]


def covariance_in(found, labels):
    at = {label: i for i, label in enumerate(found.labels)}
    C = np.zeros((len(labels), len(labels)))
    for i, a in enumerate(labels):
        for j, b in enumerate(labels):
            if a in at and b in at:
                C[i, j] = found.covariance[at[a], at[b]]
    return C


def test_some_planes_only():
    one = plan(CELL, 10, planes=["2"])
    assert set(one.plane) == set(one.after) == {"2"}
    for wrong in (["3"], [], ["1", "1"]):
        with pytest.raises(DataError, match="planes: expected some of 1, 2, each once"):
            plan(CELL, 10, planes=wrong)


def test_a_calibrations_habits_become_limits():
    made = simulate("paper-2", 1, NOISE, groups=2)
    found = lc.calibrate(made.observations)
    limits = limits_of(found)
    assert 0.02 < limits.beam_length[0] < limits.beam_length[1] < 0.3
    turned = limits.posture @ np.swapaxes(made.observations.T_base_hand[:, :3, :3], 1, 2)
    angle = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.mean() < 60


def test_one_plane_and_several_cameras():
    alone = plan(paper_cell(1), 20)
    labels = tangent_labels(paper_cell(1))
    assert len(labels) == 22
    assert set(alone.plane) == {"1"}
    two = replace(CELL, cameras={"a": CELL.cameras["camera"], "b": CELL.cameras["camera"]})
    with pytest.raises(DataError, match="camera: the cell has a, b; none was named"):
        plan(two, 10)
    assert plan(two, 10, camera="b").camera == "b"


def test_saved_plans_are_captures_in_the_robots_convention(forty, tmp_path):
    path = forty.save(tmp_path / "go", rotation="kuka", transform="T_base_hand", length="mm")
    text = path.read_text()
    assert "kuka" in text
    assert "images/{id}.png" in text
    (tmp_path / "go" / "images").mkdir()
    rows = (tmp_path / "go" / "poses.csv").read_text().splitlines()
    assert rows[0] == "id,plane,x,y,z,a,b,c"
    assert len(rows) == 41
    for row in rows[1:]:  # the pictures an operator saves
        (tmp_path / "go" / "images" / f"{row.split(',')[0]}.png").touch()
    capture = load_capture(path)
    np.testing.assert_allclose(capture.T_base_hand, forty.T_base_hand, atol=1e-12)
    assert list(capture.planes) == list(forty.plane)
    with pytest.raises(DataError, match="not empty"):
        forty.save(tmp_path / "go", rotation="kuka", transform="T_base_hand", length="mm")


def test_hands_go_a_short_way(forty):
    changes = np.sum(forty.plane[1:] != forty.plane[:-1])
    assert changes == 1
    R = forty.T_base_hand[:, :3, :3]
    turns = sum(not np.array_equal(a, b) for a, b in pairwise(R))
    different = len(np.unique(R.reshape(-1, 9), axis=0))
    assert turns == different - 1


def test_a_hand_that_may_not_turn_at_all():
    planned = [plan(CELL, count=4, limits=Limits(roll=roll)) for roll in (0.0, -0.0)]
    np.testing.assert_array_equal(planned[0].T_base_hand, planned[1].T_base_hand)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limits": Limits(box=((5, 5, 5), (6, 6, 6)))}, "meets plane '1' nowhere"),
        ({"count": 0}, "count: expected an integer >= 1"),
        ({"count": 100_000}, "are possible within the limits, 100000 are asked for"),
        ({"sigma_px": 0.0}, "sigma_px: expected pixels from 0.001"),
        ({"sigma_px": 1e-300}, "sigma_px: expected pixels from 0.001"),
        ({"sigma_px": float("nan")}, "sigma_px: expected pixels from 0.001"),
        ({"camera": "left"}, "'left' is not among them"),
    ],
)
def test_what_cannot_be_planned_is_refused(change, message):
    with pytest.raises(DataError, match=message):
        plan(CELL, **{"count": 10, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beam_length": (0.2, 0.1)}, "beam_length: expected 0 <= low <= high"),
        ({"cone": 2.0}, "cone, roll"),
        ({"posture": 2 * np.eye(3)}, "posture: expected a rotation matrix"),
        ({"box": ((1, 0, 0), (0, 1, 1))}, "box: expected lowest <= highest"),
        ({"margin_px": -1.0}, "margin_px"),
    ],
)
def test_wrong_limits_are_refused(change, message):
    with pytest.raises(DataError, match=message):
        Limits(**change)


def test_the_command(tmp_path, cli):
    made = simulate("paper-2", 1, NOISE, groups=2)
    found = lc.calibrate(made.observations)
    file = tmp_path / "calibration.json"
    found.save(file)
    result = cli("plan", file, "-n", "12", "-o", tmp_path / "go", "--rotation", "ur")
    assert result.status == 0, result.err
    assert "12 poses:" in result.out
    assert "lasercal calibrate" in result.out
    assert (tmp_path / "go" / "capture.yaml").exists()
    more = cli.json("plan", file, "--next", "-n", "2")
    assert len(more["poses"]) == 2
    assert more["error_after_m"]["1"] < more["error_before_m"]["1"]
    printed = cli("plan", file, "--next")
    assert "->" in printed.out
    assert "rotation vector (deg)" in printed.out
    alone = cli.json("plan", file, "-n", "3", "--planes", "2")
    assert [pose["plane"] for pose in alone["poses"]] == ["2"] * 3
    taken = cli("plan", file, "--next", "--sigma-px", "2")
    assert taken.status == 2
    assert "--next takes the distortion terms and the pixel noise" in taken.err
    paper = cli("plan", file, "--procedure", "1")
    assert "20 poses: 10 on plane 1, 10 on plane 2." in paper.out
    cell = tmp_path / "cell.json"
    data = json.loads(file.read_text())
    cell.write_text(json.dumps({k: data[k] for k in ("cameras", "lasers", "planes")}))
    refused = cli("plan", cell, "--next")
    assert refused.status == 1
    assert "this is only a cell" in refused.err
    assert cli("plan", cell, "--next", "--procedure", "2").status == 2
    wrong = cli("plan", cell, "--box-mm", "1,2,3")
    assert wrong.status == 2
    assert "expected 6 numbers between commas" in wrong.err
