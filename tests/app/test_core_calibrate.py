"""`calibrate` against an independent optimiser, known truths, and what it is told to hold."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, Simulation, simulate, simulate_cell
from lasercal_gtsam.solve import fold_radius, fold_warnings

NO_DISTORTION = lc.CalibrationOptions(distortion="none")


@cache
def noisy(preset: str = "paper", seed: int = 0, pixel_px: float = 1.0) -> Simulation:
    return simulate(preset, seed, Noise(pixel_px=pixel_px))


@cache
def from_truth(preset: str = "paper", seed: int = 0) -> lc.Calibration:
    made = noisy(preset, seed)
    return lc.calibrate(made.observations, initial=made.truth, options=NO_DISTORTION)


def refined(result: lc.Calibration) -> np.ndarray:
    return np.array([p.refined for p in result.parameters])


def sigmas(result: lc.Calibration) -> np.ndarray:
    return np.array([p.sigma for p in result.parameters])


def in_sigmas(a: lc.Calibration, b: lc.Calibration) -> float:
    """Largest difference of two results in sigmas of the second (held rows must be equal)."""
    free = sigmas(b) > 0
    np.testing.assert_array_equal(refined(a)[~free], refined(b)[~free])
    return float(np.abs((refined(a) - refined(b))[free] / sigmas(b)[free]).max())


# --- against an independent optimiser -----------------------------------------------------------
#
# A cell of one camera and one laser as plain numbers in a parametrisation of our own: rotation
# vector, translation, fu fv skew u0 v0 and some distortion terms, beam (1, s, t) through (0, y, z),
# planes by two angles and the distance.


def pack(cell: lc.Cell, terms: int) -> np.ndarray:
    (camera,), (beam,) = cell.cameras.values(), cell.lasers.values()
    T, u, q = camera.T_base_camera, beam.direction_hand, beam.point_hand
    cross = q - q[0] / u[0] * u
    p = [*Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]]
    p += [*camera.intrinsics.vector[: 5 + terms], u[1] / u[0], u[2] / u[0], cross[1], cross[2]]
    for plane in cell.planes.values():
        n = plane.normal_base
        p += [np.arctan2(n[1], n[0]), np.arcsin(n[2]), plane.distance]
    return np.array(p)


def unpack(p: np.ndarray, terms: int, like: lc.Cell) -> lc.Cell:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(p[:3]).as_matrix(), p[3:6]
    camera = lc.Camera(lc.Intrinsics(*p[6 : 11 + terms]), T, like.cameras["camera"].image_size)
    s, t, y, z = p[11 + terms : 15 + terms]
    planes = {}
    for name, (az, el, d) in zip(like.planes, p[15 + terms :].reshape(-1, 3), strict=True):
        n = [np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)]
        planes[name] = lc.Plane(n, d)
    return lc.Cell({"camera": camera}, {"laser": lc.Beam([1, s, t], [0, y, z])}, planes)


def table_rows(p: np.ndarray, terms: int) -> np.ndarray:
    """Rows of the paper's Table 2 (px, deg, mm), by their definitions."""
    head = np.concatenate([p[6 : 11 + terms], np.zeros(4 - terms)])
    head[2] /= head[0]
    angles = np.degrees(Rotation.from_rotvec(p[:3]).as_euler("ZYX"))
    s, t, y, z = p[11 + terms : 15 + terms]
    beam = [
        np.degrees(np.arctan2(s, 1)),
        np.degrees(np.arctan2(np.hypot(1, s), t)),
        y * 1e3,
        z * 1e3,
    ]
    planes = [
        1e3 * d * np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        for az, el, d in p[15 + terms :].reshape(-1, 3)
    ]
    return np.concatenate([head, angles, 1e3 * p[3:6], beam, *planes])


def slopes(f, p: np.ndarray) -> np.ndarray:
    """Jacobian by central differences."""
    columns = []
    for k in range(len(p)):
        h = np.zeros(len(p))
        h[k] = 1e-6 * max(1.0, abs(p[k])) if 6 <= k < 11 else 1e-6
        columns.append((f(p + h) - f(p - h)) / (2 * h[k]))
    return np.column_stack(columns)


@pytest.mark.parametrize(
    ("preset", "pixel_px", "terms"), [("paper", 1.0, 0), ("paper-distorted", 0.2, 4)]
)
def test_optimum_and_sigmas_are_those_of_an_independent_optimiser(preset, pixel_px, terms):
    made = noisy(preset, 1, pixel_px)
    seen, truth = made.observations, made.truth
    plane = seen.plane.tolist()

    def residuals(p: np.ndarray) -> np.ndarray:
        return (
            lc.project(unpack(p, terms, truth), seen.T_base_hand, plane=plane) - seen.uv
        ).ravel()

    found = least_squares(
        residuals, pack(truth, terms), jac="3-point", x_scale="jac", xtol=1e-14, ftol=1e-14
    ).x
    for _ in range(3):  # Gauss-Newton to the last digits
        found = found - np.linalg.lstsq(slopes(residuals, found), residuals(found), rcond=None)[0]
    J, r = slopes(residuals, found), residuals(found)
    s0_squared = r @ r / (len(r) - len(found))
    F = slopes(lambda p: table_rows(p, terms), found)
    variance = np.diag(F @ np.linalg.inv(J.T @ J) @ F.T) * s0_squared

    options = replace(NO_DISTORTION, distortion="all" if terms else "none")
    result = lc.calibrate(seen, options=options)  # from the data alone
    assert result.fit.converged
    free = variance > 0
    np.testing.assert_array_equal(sigmas(result) > 0, free)
    off = (refined(result) - table_rows(found, terms))[free] / np.sqrt(variance[free])
    assert np.abs(off).max() < 1e-5
    np.testing.assert_allclose(sigmas(result)[free], np.sqrt(variance[free]), rtol=1e-3)
    assert result.fit.sigma0 == pytest.approx(np.sqrt(s0_squared), rel=1e-9)
    assert result.fit.dof == len(r) - len(found)
    assert result.fit.rms_px == pytest.approx(np.sqrt(2 * np.mean(r**2)), rel=1e-9)
    np.testing.assert_allclose(result.spots.residual_px.ravel(), r, rtol=0, atol=1e-5)


# --- the truth comes back -----------------------------------------------------------------------


def relative_error(found: lc.Cell, truth: lc.Cell) -> float:
    """Largest error of intrinsics (focal length as unit), rotations, directions and lengths."""
    errors = []
    for name, camera in truth.cameras.items():
        a, b = found.cameras[name], camera
        scale = np.r_[np.full(5, b.intrinsics.fu), np.ones(4)]
        errors.append((a.intrinsics.vector - b.intrinsics.vector) / scale)
        errors.append((a.T_base_camera - b.T_base_camera).ravel())
    for name, beam in truth.lasers.items():
        other = found.lasers[name]
        errors.append(other.direction_hand - beam.direction_hand)
        errors.append(np.cross(beam.direction_hand, other.point_hand - beam.point_hand))
    for name, plane in truth.planes.items():
        errors.append(found.planes[name].normal_base - plane.normal_base)
        errors.append([found.planes[name].distance - plane.distance])
    return float(np.abs(np.concatenate(errors)).max())


@pytest.mark.parametrize(
    ("preset", "limit"),
    [
        ("paper", 1e-9), ("paper-2", 1e-9), ("paper-1", 1e-8), ("table2-4", 1e-9),
        ("table2-2", 1e-8), ("tool-z", 1e-8), ("no-groups", 1e-9),
    ],
)  # fmt: skip
def test_without_noise_the_data_alone_give_the_truth(preset, limit):
    made = simulate(preset, seed=4)
    result = lc.calibrate(made.observations, options=lc.CalibrationOptions(known=made.known))
    assert result.fit.converged
    assert result.fit.n_rejected == 0
    assert relative_error(result.cell, made.truth) < limit


def test_the_order_of_the_spots_does_not_matter():
    made = noisy()
    order = np.random.default_rng(3).permutation(len(made.observations))
    plain = lc.calibrate(made.observations, options=NO_DISTORTION)
    shuffled = lc.calibrate(made.observations[order], options=NO_DISTORTION)
    assert in_sigmas(shuffled, plain) < 1e-7
    np.testing.assert_allclose(sigmas(shuffled), sigmas(plain), rtol=1e-7)
    assert shuffled.spots.id.tolist() == made.observations.id[order].tolist()
    np.testing.assert_allclose(
        shuffled.spots.residual_px, plain.spots.residual_px[order], rtol=0, atol=1e-7
    )


def test_the_same_input_gives_the_same_bits():
    made = noisy("paper-2")
    a, b = (lc.calibrate(made.observations, options=NO_DISTORTION) for _ in range(2))
    assert a == b
    assert a.covariance.tobytes() == b.covariance.tobytes()


def two_cameras() -> lc.Cell:
    cell = simulate("paper-2", 0).truth
    left = cell.cameras["camera"]
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec([0.15, -0.2, 0.6]).as_matrix()
    step[:3, 3] = [0.05, 0.04, -0.02]
    intrinsics = lc.Intrinsics(700, 690, 1.0, 410, 290, k1=-0.1)
    right = lc.Camera(intrinsics, left.T_base_camera @ step, (800, 600))
    return lc.Cell({"left": left, "right": right}, cell.lasers, cell.planes)


def test_two_cameras_share_beam_and_planes():
    cell = two_cameras()
    a = simulate_cell(cell, camera="left", prefix="l", seed=1).observations
    b = simulate_cell(cell, camera="right", prefix="r", seed=2).observations
    result = lc.calibrate(a + b)
    assert result.fit.converged
    assert relative_error(result.cell, cell) < 1e-8
    names = [p.name for p in result.parameters]
    assert names[0] == "left.fu"
    assert names[15] == "right.fu"
    assert names[30] == "laser_theta"
    assert len(names) == 2 * 15 + 4 + 2 * 3
    assert result["right.u0"].refined == pytest.approx(410, abs=1e-5)


def test_two_lasers_share_camera_and_planes():
    cell = simulate("paper-2", 0).truth
    other = lc.Beam([-0.3, 0.5, 0.8], [0.02, 0.01, 0.0])
    cell = lc.Cell(cell.cameras, {"red": cell.lasers["laser"], "green": other}, cell.planes)
    a = simulate_cell(cell, laser="red", prefix="r", seed=1).observations
    b = simulate_cell(cell, laser="green", prefix="g", seed=2).observations
    result = lc.calibrate(a + b)
    assert result.fit.converged
    assert relative_error(result.cell, cell) < 1e-8
    names = [p.name for p in result.parameters]
    assert names[0] == "fu"
    assert [n.split(".")[0] for n in names[15:23]] == ["green"] * 4 + ["red"] * 4
    with pytest.raises(KeyError, match=r"red\.laser_theta"):
        result["laser_theta"]


# --- what is held, known, tied, or has a prior --------------------------------------------------


@pytest.mark.parametrize(
    ("known", "rows"),
    [
        ({"principal_point": (322.0, 239.0)}, {"u0": 322.0, "v0": 239.0}),
        ({"skew": 0.0}, {"alpha_c": 0.0}),
        ({"fu": 551.0}, {"fu": 551.0}),
        ({"camera.fv": 549.0, "v0": 241.0}, {"fv": 549.0, "v0": 241.0}),
        ({"k1": 0.01, "p2": 1e-3}, {"k1": 0.01, "p2": 1e-3}),
    ],
)
@pytest.mark.parametrize("started", [False, True])
def test_known_values_are_held(known, rows, started):
    made = noisy()
    options = replace(NO_DISTORTION, known=known)
    result = lc.calibrate(
        made.observations, initial=made.truth if started else None, options=options
    )
    assert result.fit.converged
    for name, value in rows.items():
        assert (result[name].refined, result[name].sigma) == (value, 0.0)
    free = sum(p.sigma > 0 for p in result.parameters)
    assert free == sum(p.sigma > 0 for p in from_truth().parameters) - len(set(rows) - {"k1", "p2"})
    for key in known:
        assert any(
            words.startswith(f"{key} held at the known") for words in result.observability.held
        )


@pytest.mark.parametrize("part", ["laser:laser", "plane:1", "camera:camera"])
def test_fixed_parts_keep_the_start_bit_for_bit(part):
    made = noisy()
    result = lc.calibrate(
        made.observations, initial=made.truth, options=replace(NO_DISTORTION, fixed=(part,))
    )
    kind, _, name = part.partition(":")
    found = getattr(result.cell, {"laser": "lasers", "plane": "planes", "camera": "cameras"}[kind])
    start = getattr(made.truth, {"laser": "lasers", "plane": "planes", "camera": "cameras"}[kind])
    assert found[name] == start[name]
    rows = {
        "laser": ["laser_theta", "laser_phi", "laser_y", "laser_z"],
        "plane": ["a_1_x", "a_1_y", "a_1_z"],
        "camera": ["fu", "fv", "alpha_c", "u0", "v0", "theta", "phi", "psi", "Tx", "Ty", "Tz"],
    }[kind]
    held = {p.name for p in result.parameters if p.sigma == 0}
    assert held == {*rows, "k1", "k2", "p1", "p2"}
    for name in rows:
        assert result[name].refined == result[name].initial
    assert f"{part} held at the start's value (fixed)" in result.observability.held
    assert result.fit.dof == from_truth().fit.dof + len(rows)


def test_fixed_single_values_and_groups():
    made = noisy()
    options = replace(NO_DISTORTION, fixed=("u0", "camera.alpha_c", "T_base_camera"))
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    start, end = made.truth.cameras["camera"], result.cell.cameras["camera"]
    np.testing.assert_array_equal(end.T_base_camera, start.T_base_camera)
    assert (end.intrinsics.u0, end.intrinsics.skew) == (320.0, 0.0)
    assert end.intrinsics.v0 != 240.0


@pytest.mark.parametrize("aspect", [1.0, 0.99])
def test_a_tied_aspect_is_exact(aspect):
    made = noisy()
    result = lc.calibrate(
        made.observations, options=replace(NO_DISTORTION, known={"aspect": aspect})
    )
    fu, fv = result["fu"], result["fv"]
    assert fu.refined == pytest.approx(aspect * fv.refined, rel=1e-15)
    assert fv.sigma > 0
    assert fu.sigma == pytest.approx(aspect * fv.sigma, rel=1e-12)
    assert result.fit.dof == from_truth().fit.dof + 1


def test_a_prior_weighs_as_one_more_measurement():
    made, plain = noisy(), from_truth()["Tz"]
    mean = plain.refined + 0.5 * plain.sigma

    def with_sigma(sigma: float) -> lc.Parameter:
        options = replace(NO_DISTORTION, priors={"Tz": (mean, sigma)})
        result = lc.calibrate(made.observations, initial=made.truth, options=options)
        assert result.fit.converged
        return result["Tz"]

    tight = with_sigma(0.01 * plain.sigma)
    assert abs(tight.refined - mean) < 0.01 * plain.sigma
    assert tight.sigma == pytest.approx(0.01 * plain.sigma, rel=0.01)
    # a prior as good as the data: half way, and 1 / sqrt(2) of the sigma
    equal = with_sigma(plain.sigma)
    assert equal.refined - plain.refined == pytest.approx(0.25 * plain.sigma, rel=0.1)
    assert equal.sigma == pytest.approx(plain.sigma / np.sqrt(2), rel=0.03)
    # a prior that says nothing
    vague = with_sigma(1e4 * plain.sigma)
    assert abs(vague.refined - plain.refined) < 1e-5 * plain.sigma


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"known": {"focal": 3}}, r"options\.known: unknown name 'focal'; allowed: .*aspect, fu"),
        ({"known": {"right.fu": 3}}, r"options\.known: .*names the camera 'right'; observed"),
        ({"known": {"principal_point": 3}}, r"principal_point must be \(u0, v0\), got 3"),
        ({"known": {"fu": -3}}, "fu must be positive"),
        ({"known": {"aspect": 1, "fu": 500, "fv": 600}}, "leave one of the three out"),
        ({"fixed": ("beam",)}, r"options\.fixed: unknown name 'beam'; allowed: .*T_base_camera"),
        (
            {"fixed": ("laser:red",)},
            r"'laser:red' is no part .*camera:camera, laser:laser, plane:1",
        ),
        ({"priors": {"Tq": (0, 1)}}, r"options\.priors: unknown name 'Tq'; allowed: .*Tz.*a_3_z"),
        ({"priors": {"Tz": 430}}, r"options\.priors\['Tz'\]: expected \(mean, sigma\)"),
        ({"priors": {"Tz": (430, 0)}}, r"a sigma > 0"),
        ({"known": {"u0": 1}, "priors": {"u0": (1, 1)}}, "u0 is held"),
    ],
)
def test_wrong_wishes_are_refused_in_words(fields, words):
    made = noisy()
    with pytest.raises(lc.DataError, match=words):
        lc.calibrate(made.observations, initial=made.truth, options=lc.CalibrationOptions(**fields))


def test_nothing_can_be_fixed_at_a_start_that_is_not_given():
    with pytest.raises(lc.DataError, match=r"'plane:1' is to be held .* no start is given"):
        lc.calibrate(noisy().observations, options=lc.CalibrationOptions(fixed=("plane:1",)))
    with pytest.raises(lc.DataError, match="initial: expected a Cell, got dict"):
        lc.calibrate(noisy().observations, initial={})


def test_one_plane_says_what_it_assumed():
    made = noisy("paper-1")
    result = lc.calibrate(made.observations)
    held = "; ".join(result.observability.held)
    assert "one plane only: u0 = 320, v0 = 240, skew = 0 assumed and held" in held
    assert "weak priors fu/fv 1 +- 0.01, k1 0 +- 1" in held
    assert [p.name for p in result.parameters if p.sigma == 0] == ["alpha_c", "u0", "v0"]


# --- what cannot be determined ------------------------------------------------------------------


def one_rotation() -> tuple[lc.Observations, lc.Cell]:
    """Pure translations: every spot under the same hand rotation."""
    made = simulate("paper-2", 0)
    T = np.stack([made.observations.T_base_hand[0]] * 60)
    T[:, :3, 3] += np.random.default_rng(0).uniform(-0.03, 0.03, (60, 3))
    plane = ["1", "2"] * 30
    uv = lc.project(made.truth, T, plane=plane)
    seen = np.isfinite(uv).all(axis=1)
    uv, T, plane = uv[seen], T[seen], np.array(plane)[seen].tolist()
    return lc.Observations.from_arrays(uv, T, plane=plane, image_size=(640, 480)), made.truth


def facing() -> tuple[lc.Observations, lc.Cell]:
    """One plane straight across the optical axis."""
    cell = simulate("paper-1", 0).truth
    T = cell.cameras["camera"].T_base_camera
    plane = lc.Plane.from_point(T[:3, 2], T[:3, 3] + 0.3 * T[:3, 2])
    cell = cell.with_planes({"1": plane})
    return simulate_cell(cell, groups=4).observations, cell


def too_few() -> tuple[lc.Observations, lc.Cell]:
    made = simulate("paper-2", 0)
    return made.observations[[0, 1, 2, 31, 32]], made.truth


@pytest.mark.parametrize(
    ("case", "words"),
    [
        (one_rotation, "all 60 shots have the same hand orientation"),
        (facing, "the plane is parallel to the image"),
        (too_few, "5 spots on 2 planes are too few"),
    ],
)
@pytest.mark.parametrize("started", [False, True])
def test_what_the_data_cannot_give_is_refused_in_words(case, words, started):
    seen, cell = case()
    with pytest.raises(lc.DegenerateError) as caught:
        lc.calibrate(seen, initial=cell if started else None)
    message = str(caught.value)
    if started:  # names what moves together, in units
        assert "undetermined: (1) camera." in message
        assert "Add hand orientations" in message
    else:
        assert words in message


def test_no_spots_at_all():
    with pytest.raises(lc.DataError, match="there are no spots"):
        lc.calibrate(noisy().observations[[]])


# --- outliers and hand noise --------------------------------------------------------------------


def test_gross_outliers_are_named_and_leave_no_trace():
    made = noisy()
    seen, bad = made.observations, [4, 37, 80]
    uv = seen.uv.copy()
    uv[bad] += [[60.0, -30.0], [-25.0, 40.0], [0.0, 90.0]]
    spoilt = replace(seen, uv=uv)
    result = lc.calibrate(spoilt, initial=made.truth, options=NO_DISTORTION)
    assert [k for k, spot in enumerate(result.spots) if spot.rejected] == bad
    assert all(len(result.spots.rejected[k].split()) > 3 for k in bad)
    assert result.fit.n_rejected == 3
    assert result.fit.n_spots == len(seen) - 3
    assert "3 rejected as outliers" in result.fit.status
    np.testing.assert_array_equal(np.flatnonzero(result.spots.weight == 0), bad)
    good = np.setdiff1d(np.arange(len(seen)), bad)
    without = lc.calibrate(
        seen[good], initial=made.truth, options=replace(NO_DISTORTION, robust="none")
    )
    assert in_sigmas(result, without) < 1e-6
    np.testing.assert_allclose(sigmas(result), sigmas(without), rtol=1e-6)
    # the residuals of the rejected are told too
    assert np.linalg.norm(result.spots.residual_px[bad], axis=1).min() > 30


@pytest.mark.parametrize("started", [False, True])
def test_clean_data_give_the_same_bits_with_and_without_outlier_search(started):
    made = noisy(seed=2)
    initial = made.truth if started else None
    a, b = (
        lc.calibrate(
            made.observations, initial=initial, options=replace(NO_DISTORTION, robust=robust)
        )
        for robust in ("auto", "none")
    )
    assert a.cell == b.cell
    assert a.parameters == b.parameters
    assert a.covariance.tobytes() == b.covariance.tobytes()


def test_stated_hand_noise_is_weighed_and_the_sigmas_stay_honest():
    noise = Noise.table1(1.0)
    stated = replace(
        NO_DISTORTION,
        sigma_px=noise.pixel_px,
        hand_sigma_m=noise.hand_translation_m,
        hand_sigma_rad=noise.hand_rotation_rad,
    )
    z, scales = [], []
    for seed in range(20):
        made = simulate("paper", seed, noise)
        result = lc.calibrate(made.observations, initial=made.truth, options=stated)
        assert result.fit.converged
        free = sigmas(result) > 0
        truth = np.array([p.initial for p in result.parameters])  # the start is the truth
        z.append((refined(result) - truth)[free] / sigmas(result)[free])
        scales.append(result.fit.sigma0)
        if seed == 0:
            plain = lc.calibrate(made.observations, initial=made.truth, options=NO_DISTORTION)
            assert in_sigmas(plain, result) > 0.05
            assert plain.fit.sigma0 > 1.5
    assert np.mean(scales) == pytest.approx(1.0, abs=0.05)
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3


# --- table and status ---------------------------------------------------------------------------


def test_the_table_is_that_of_the_paper():
    result = from_truth()
    lines = result.table().splitlines()
    heading = [word.strip() for word in lines[0].split("|")]
    assert heading == ["", "Initial", "Refined", "sigma", "Unit"]
    rules = [k for k, line in enumerate(lines) if set(line) <= {"-", "+"}]
    assert rules == [1, len(lines) - 2]
    assert len(lines) == len(result.parameters) + 4
    bars = {tuple(k for k, c in enumerate(line) if c in "|+") for line in lines}
    assert len(bars) == 1  # every bar under the one above
    assert lines[-1].split() == ["RMS", "|", "|", f"{result.fit.rms_px:.4g}", "|", "|", "px"]
    for line, p in zip(lines[2:-2], result.parameters, strict=True):
        name, initial, value, sigma, unit = (word.strip() for word in line.split("|"))
        assert (name, unit) == (p.name, p.unit)
        if p.name in ("k1", "k2", "p1", "p2"):
            assert sigma == "held"
        else:
            assert float(sigma) == pytest.approx(p.sigma, rel=0.06)  # two digits
            digits = len(value.partition(".")[2])
            assert abs(float(value) - p.refined) <= 0.5001 * 10.0**-digits
            assert abs(float(initial) - p.initial) <= 0.5001 * 10.0**-digits
            assert len(sigma.partition(".")[2]) == digits


def test_the_status_is_one_sentence():
    fit = from_truth().fit
    assert fit.converged
    assert fit.status == (
        f"converged ({fit.iterations} iterations): 90 spots, RMS {fit.rms_px:.3g} px"
    )


def test_a_fold_inside_the_image_is_warned_of():
    strong = lc.Intrinsics(550, 550, 0, 320, 240, k1=-0.8)
    mild = lc.Intrinsics(550, 550, 0, 320, 240, k1=-0.1)
    radius = fold_radius(strong)
    r = 1 / np.sqrt(2.4)  # 1 - 2.4 r^2 = 0
    assert radius == pytest.approx(r * (1 - 0.8 * r * r), rel=1e-12)
    assert fold_radius(lc.Intrinsics(550, 550, k1=-0.5, k2=1.1)) == np.inf  # 9 k1^2 < 20 k2
    beam = lc.Beam([0, 0, 1], [0, 0, 0])

    def warned(intrinsics: lc.Intrinsics) -> list[str]:
        return fold_warnings(
            lc.Cell({"left": lc.Camera(intrinsics, np.eye(4), (640, 480))}, {"laser": beam})
        )

    assert warned(mild) == []
    (words,) = warned(strong)
    assert "camera 'left'" in words
    assert f"folds {550 * radius:.0f} px from the principal point" in words
    assert "inside the image" in words
