"""What is held, known, tied or given a prior: names, values, sigmas, and the effect on the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core_cases import OtherSolver, distance_in_sigmas, moved_intrinsics, rows_of, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.holds import ONE_PLANE_PRIORS, resolve_holds
from lasercal_gtsam.report_map import CAMERA_TANGENT, tangent_labels
from lasercal_gtsam.simulate import PRESETS

# how near the optimum a solve ends (sigmas)
REACHED = 1e-5


@pytest.fixture(scope="module")
def paper():
    return simulated("paper", 3, 1.0)


@pytest.fixture(scope="module")
def one_plane():
    return simulated("table2-2", 3, 0.5)


def options(**changes):
    return lc.CalibrationOptions(**({"robust": "none"} | changes))


def calibrate(simulation, initial=True, **changes):
    start = simulation.truth if initial else None
    return lc.calibrate(simulation.observations, initial=start, options=options(**changes))


def renamed(simulation, camera):
    """The same spots seen by a camera of that name."""
    seen = simulation.observations
    sizes = {camera: seen.image_size["camera"]}
    return replace(seen, camera=np.array([camera] * len(seen)), image_size=sizes)


def held_names(observations, initial=None, **changes):
    holds = resolve_holds(observations, options(**changes), initial)
    labels = []
    for c in observations.cameras:
        labels += [f"{c}.{t}" for t in CAMERA_TANGENT]
    for laser in observations.lasers:
        labels += [f"{laser}.{t}" for t in ("slope_a", "slope_b", "offset_x", "offset_y")]
    for plane in observations.planes:
        labels += [f"plane {plane}.{t}" for t in ("normal_1", "normal_2", "distance")]
    assert len(labels) == len(holds.held)
    return {name for name, held in zip(labels, holds.held, strict=True) if held}


# --- names --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", INTRINSIC_NAMES)
def test_every_intrinsic_can_be_known_or_fixed(paper, name):
    seen, value = paper.observations, 0.01 if name in ("k1", "k2", "p1", "p2") else 300.0
    assert held_names(seen, known={name: value}) == {f"camera.{name}"}
    assert held_names(seen, paper.truth, fixed=(name,)) == {f"camera.{name}"}
    holds = resolve_holds(seen, options(known={name: value}))
    start = holds.apply(paper.truth).cameras["camera"].intrinsics
    assert start == replace(paper.truth.cameras["camera"].intrinsics, **{name: value})


@pytest.mark.parametrize(
    ("name", "terms"),
    [
        ("intrinsics", INTRINSIC_NAMES),
        ("T_base_camera", CAMERA_TANGENT[:6]),
        ("distortion", ("k1", "k2", "p1", "p2")),
        ("principal_point", ("u0", "v0")),
        ("alpha_c", ("skew",)),
        ("camera:camera", CAMERA_TANGENT),
    ],
)
def test_groups_of_names(paper, name, terms):
    found = held_names(paper.observations, paper.truth, fixed=(name,))
    assert found == {f"camera.{t}" for t in terms}


def test_whole_lasers_and_planes(paper):
    seen, truth = paper.observations, paper.truth
    laser = held_names(seen, truth, fixed=("laser:laser",))
    assert laser == {f"laser.{t}" for t in ("slope_a", "slope_b", "offset_x", "offset_y")}
    plane = held_names(seen, truth, fixed=("plane:2",))
    assert plane == {f"plane 2.{t}" for t in ("normal_1", "normal_2", "distance")}


def test_several_cameras_are_told_apart_by_prefix(paper):
    two = renamed(paper, "left") + renamed(paper, "right.b")
    assert held_names(two, known={"left.skew": 0}) == {"left.skew"}
    assert held_names(two, known={"right.b.skew": 0}) == {"right.b.skew"}
    assert held_names(two, known={"skew": 0}) == {"left.skew", "right.b.skew"}
    assert held_names(two, known={"principal_point": (320, 240)}) == {
        "left.u0", "left.v0", "right.b.u0", "right.b.v0",
    }  # fmt: skip
    assert held_names(two, paper.truth, fixed=("right.b.distortion",)) == {
        f"right.b.{t}" for t in ("k1", "k2", "p1", "p2")
    }
    assert held_names(two, paper.truth, fixed=("camera:left",)) == {
        f"left.{t}" for t in CAMERA_TANGENT
    }


@pytest.mark.parametrize(
    ("wanted", "free"),
    [("all", "k1 k2 p1 p2"), ("none", ""), (("k1",), "k1"), (("k1", "p2"), "k1 p2"), ((), "")],
)
def test_distortion_by_name(paper, wanted, free):
    held = held_names(paper.observations, distortion=wanted)
    assert held == {f"camera.{t}" for t in ("k1", "k2", "p1", "p2") if t not in free.split()}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"known": {"f": 1}}, ["options.known", "'f'", "principal_point, aspect", "fu", "p2"]),
        ({"known": {"left.fu": 1}}, ["options.known", "'left'", "camera"]),
        ({"known": {"fu": -3}}, ["fu", "positive"]),
        ({"known": {"aspect": 0}}, ["aspect", "positive"]),
        ({"known": {"skew": "x"}}, ["skew", "a finite number", "'x'"]),
        ({"known": {"u0": np.nan}}, ["u0", "a finite number"]),
        ({"known": {"principal_point": 320}}, ["principal_point", "(u0, v0)"]),
        ({"fixed": ("k3",)}, ["options.fixed", "'k3'", "intrinsics", "plane:<name>"]),
        ({"fixed": ("rot_x",)}, ["options.fixed", "'rot_x'"]),
        ({"fixed": ("plane:9",)}, ["options.fixed", "plane:9", "plane:1", "laser:laser"]),
        ({"fixed": ("tool:1",)}, ["options.fixed", "tool:1"]),
        ({"priors": {"f": (1, 1)}}, ["options.priors", "'f'", "laser_theta", "a_3_z", "aspect"]),
        ({"priors": {"camera.fu": (1, 1)}}, ["options.priors", "'camera.fu'", "fu"]),
        ({"priors": {"fu": 550}}, ["options.priors['fu']", "(mean, sigma)"]),
        ({"priors": {"fu": (550, 0)}}, ["options.priors['fu']", "sigma > 0"]),
        ({"priors": {"fu": (np.inf, 1)}}, ["options.priors['fu']", "finite mean"]),
        ({"priors": {"aspect": (-1, 1)}}, ["options.priors['aspect']", "positive"]),
        # wishes that contradict each other
        ({"known": {"u0": 320}, "priors": {"u0": (330, 1)}}, ["u0", "held", "leave one"]),
        ({"known": {"aspect": 1}, "priors": {"aspect": (1, 1)}}, ["aspect", "tied"]),
        ({"distortion": "none", "priors": {"k1": (0, 1)}}, ["k1", "left out of the distortion"]),
        ({"known": {"aspect": 1, "fu": 550, "fv": 540}}, ["aspect", "fu and fv"]),
        ({"known": {"aspect": 1}, "fixed": ("intrinsics",)}, ["aspect", "fu and fv"]),
    ],
)  # fmt: skip
def test_wrong_names_and_values_are_listed(paper, changes, words):
    with pytest.raises(lc.DataError) as caught:
        calibrate(paper, **changes)
    for word in words:
        assert word in str(caught.value)


def test_nothing_is_held_at_a_start_that_was_not_given(paper):
    for name in ("camera:camera", "skew", "T_base_camera", "plane:1", "intrinsics"):
        with pytest.raises(lc.DataError, match="no start is given"):
            calibrate(paper, initial=False, fixed=(name,))
    # distortion starts at zero
    result = calibrate(paper, initial=False, fixed=("k2", "p1", "p2"))
    assert [result[name].refined for name in ("k2", "p1", "p2")] == [0.0, 0.0, 0.0]


# --- what it does -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fixed", ["camera:camera", "laser:laser", "plane:2", "T_base_camera", "intrinsics"]
)
def test_what_is_fixed_does_not_move_a_bit_and_has_no_sigma(paper, fixed):
    result = calibrate(paper, fixed=(fixed,))
    assert result.fit.converged
    kind, _, name = fixed.partition(":")
    before, after = paper.truth, result.cell
    if kind in ("camera", "laser", "plane"):
        assert getattr(after, kind + "s")[name] == getattr(before, kind + "s")[name]
    elif kind == "intrinsics":
        assert after.cameras["camera"].intrinsics == before.cameras["camera"].intrinsics
    else:
        a, b = (c.cameras["camera"].T_base_camera for c in (after, before))
        np.testing.assert_array_equal(a, b)
    rows = {
        "camera": [*INTRINSIC_NAMES[:2], "alpha_c", "u0", "k1", "theta", "phi", "psi", "Tx", "Tz"],
        "laser": ["laser_theta", "laser_phi", "laser_y", "laser_z"],
        "plane": ["a_2_x", "a_2_y", "a_2_z"],
        "T_base_camera": ["theta", "phi", "psi", "Tx", "Ty", "Tz"],
        "intrinsics": ["fu", "fv", "alpha_c", "u0", "v0", "k1", "k2", "p1", "p2"],
    }[kind]
    assert {result[row].sigma for row in rows} == {0.0}
    free = [p for p in result.parameters if p.name not in rows and p.name.startswith("a_1")]
    assert all(p.sigma > 0 for p in free)
    held = np.array([label in held_labels(result, fixed) for label in result.labels])
    assert not result.covariance[held].any()
    assert not result.covariance[:, held].any()


def held_labels(result, fixed):
    return held_names(result.inputs.observations, result.cell, fixed=(fixed,))


@pytest.mark.parametrize("held", [("skew", "u0", "v0"), ("k2", "p1", "p2")])
def test_the_rest_is_as_another_solver_finds_it(paper, held):
    truth = paper.truth.cameras["camera"].intrinsics
    result = calibrate(paper, initial=False, known={t: getattr(truth, t) for t in held})
    other = OtherSolver.about(paper.observations, paper.truth, held).solve()
    assert distance_in_sigmas(result, other.cell) < REACHED
    sigma0 = np.sqrt(other.cost / (2 * len(paper.observations) - other.unknowns))
    sigmas = np.array([p.sigma for p in result.parameters])
    np.testing.assert_allclose(
        sigmas, sigma0 * np.sqrt(np.abs(np.diag(other.covariance))), rtol=1e-4, atol=1e-12
    )


@pytest.mark.parametrize("aspect", [1.0, 1.003])
def test_tied_focal_lengths_are_one_parameter(paper, aspect):
    result = calibrate(paper, initial=False, known={"aspect": aspect})
    intrinsics = result.cell.cameras["camera"].intrinsics
    assert intrinsics.fu == aspect * intrinsics.fv
    assert result["fu"].sigma == pytest.approx(aspect * result["fv"].sigma, rel=1e-12)
    other = OtherSolver.about(paper.observations, paper.truth, held=("fu",))

    def tie(x):
        x[6] = aspect * x[7]
        return x

    found = other.solve(tie=tie)
    assert distance_in_sigmas(result, found.cell) < REACHED
    sigma0 = np.sqrt(found.cost / (2 * len(paper.observations) - found.unknowns))
    sigmas = np.array([p.sigma for p in result.parameters])
    np.testing.assert_allclose(sigmas, sigma0 * np.sqrt(np.diag(found.covariance)), rtol=1e-4)
    assert result.fit.dof == 2 * len(paper.observations) - found.unknowns


@pytest.mark.parametrize(
    ("changes", "fu", "fv"),
    [
        ({"known": {"aspect": 1.1, "fu": 561.0}}, 561.0, 510.0),
        ({"known": {"aspect": 1.1, "fv": 500.0}}, 550.0, 500.0),
        ({"known": {"aspect": 1.1}, "fixed": ("fu",)}, 550.0, 500.0),
        ({"known": {"aspect": 1.1}, "fixed": ("fv",)}, 605.0, 550.0),
        ({"known": {"aspect": 1.1, "fu": 550.0, "fv": 500.0}}, 550.0, 500.0),
    ],
)
def test_one_known_focal_length_gives_the_tied_one(paper, changes, fu, fv):
    result = calibrate(paper, **changes)
    assert result["fu"].refined == pytest.approx(fu, rel=1e-14)
    assert result["fv"].refined == pytest.approx(fv, rel=1e-14)
    assert result["fu"].sigma == result["fv"].sigma == 0.0


@pytest.mark.parametrize(
    "prior",
    [
        {"u0": (330.0, 2.0)},
        {"k1": (0.1, 0.05), "alpha_c": (0.01, 0.002)},
        {"Tx": (512.0, 0.5), "theta": (-90.5, 0.1)},
        {"laser_phi": (53.0, 0.2), "laser_y": (-9.0, 0.3)},
        {"a_2_z": (-155.0, 0.2)},
        {"aspect": (1.003, 0.002)},
    ],
    ids="+".join,
)
def test_priors_pull_as_the_normal_equations_say(paper, prior):
    """An extra residual (row - mean) / sigma each, in units of the data's own scale."""
    free = calibrate(paper)
    result = calibrate(paper, priors=prior)
    assert result.fit.converged, result.fit.status
    unit = result.fit.sigma0

    def extra(cell):
        rows = rows_of(cell, paper.truth)
        rows["aspect"] = rows["fu"] / rows["fv"]
        return np.array([unit * (rows[n] - mean) / sigma for n, (mean, sigma) in prior.items()])

    found = OtherSolver.about(paper.observations, paper.truth).solve(extra)
    # the scale is found along with the rest, to half a per cent
    assert distance_in_sigmas(result, found.cell) < (0.02 if "aspect" in prior else 0.01)
    sigmas = np.array([p.sigma for p in result.parameters])
    expected = unit * np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sigmas, expected, rtol=0.01)
    rows = rows_of(result.cell) | {"aspect": result["fu"].refined / result["fv"].refined}
    before = rows_of(free.cell) | {"aspect": free["fu"].refined / free["fv"].refined}
    for name, (mean, sigma) in prior.items():
        assert abs(rows[name] - mean) < abs(before[name] - mean)
        if name != "aspect":
            assert result[name].sigma < min(sigma, free[name].sigma)


def test_a_prior_on_an_angle_knows_that_it_is_round(paper):
    """psi is near -170 deg; 190 deg is the same angle."""
    one = calibrate(paper, priors={"psi": (-171.0, 0.3)})
    other = calibrate(paper, priors={"psi": (189.0, 0.3)})
    assert distance_in_sigmas(one, other) < 1e-4


def test_a_weak_prior_changes_nothing(paper):
    result = calibrate(paper, priors={"u0": (0.0, 1e7)})
    assert distance_in_sigmas(calibrate(paper), result) < 1e-4
    assert result.fit.dof == pytest.approx(2 * 90 - 28, abs=1e-4)


def test_a_sharp_prior_is_as_good_as_knowing(paper):
    known = calibrate(paper, known={"v0": 244.0})
    sharp = calibrate(paper, priors={"v0": (244.0, 1e-4)})
    assert sharp["v0"].refined == pytest.approx(244.0, abs=1e-3)
    for a, b in zip(known.parameters, sharp.parameters, strict=True):
        if a.name != "v0":
            assert b.refined == pytest.approx(a.refined, abs=1e-3 * a.sigma)
            assert b.sigma == pytest.approx(a.sigma, rel=1e-3)
    assert sharp.fit.dof == pytest.approx(known.fit.dof, abs=1e-3)


# --- one plane ----------------------------------------------------------------------------------


def test_one_plane_holds_what_it_cannot_give_and_says_so(one_plane):
    result = calibrate(one_plane, initial=False)
    assert (result["u0"].refined, result["v0"].refined, result["alpha_c"].refined) == (320, 240, 0)
    assert {result[name].sigma for name in ("u0", "v0", "alpha_c")} == {0.0}
    words = " | ".join(result.observability.held)
    assert "one plane only: u0 = 320, v0 = 240, skew = 0 assumed and held" in words
    for term, (mean, sigma) in ONE_PLANE_PRIORS.items():
        assert f"{term.replace('aspect', 'fu/fv')} {mean:g} +- {sigma:g}" in words


def test_one_planes_assumptions_give_way_to_what_is_known(one_plane):
    seen = one_plane.observations
    assert held_names(seen) == {"camera.u0", "camera.v0", "camera.skew"}
    known = resolve_holds(seen, options(known={"principal_point": (310.0, 250.0), "aspect": 1.01}))
    assert known.known["camera"] == {"u0": 310.0, "v0": 250.0, "skew": 0.0}
    assert "aspect" not in known.priors
    start = moved_intrinsics(one_plane.truth, u0=300.0, v0=222.0, skew=1.0)
    given = resolve_holds(seen, options(), start)
    assert given.known["camera"] == {"u0": 300.0, "v0": 222.0, "skew": 1.0}
    free = resolve_holds(seen, options(priors={"u0": (315.0, 5.0), "k1": (-0.5, 0.1)}))
    assert held_names(seen, priors={"u0": (315.0, 5.0)}) == {"camera.v0", "camera.skew"}
    assert free.priors["u0"] == (315.0, 5.0)
    assert free.priors["k1"] == (-0.5, 0.1)
    assert free.priors["k2"] == ONE_PLANE_PRIORS["k2"]
    assert not set(resolve_holds(seen, options(distortion="none")).priors) & {
        "k1",
        "k2",
        "p1",
        "p2",
    }


def test_several_planes_hold_nothing(paper):
    assert held_names(paper.observations) == set()
    assert resolve_holds(paper.observations, options()).priors == {}
    assert calibrate(paper).observability.held == ()


def test_what_is_held_is_written_down(paper):
    result = calibrate(
        paper, known={"skew": 0}, fixed=("plane:1",), distortion=("k1",), priors={"u0": (320, 9)}
    )
    words = result.observability.held
    assert any("skew" in w and "known" in w for w in words)
    assert any("plane:1" in w and "fixed" in w for w in words)
    assert any("k2, p1, p2" in w and "distortion" in w for w in words)
    assert any("prior u0 = 320 +- 9" in w for w in words)


def test_labels_are_those_of_the_masks(paper):
    result = calibrate(paper)
    assert result.labels == tangent_labels(result.cell)
    assert len(result.labels) == len(resolve_holds(paper.observations, options()).held)
    assert len(PRESETS) > 5
