"""One plane (section 3.3): exact without noise, the two roots, and the corrected equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from closed_form_cases import (
    beam_of,
    camera_of,
    exact,
    groups_of,
    known_centre,
    largest_error,
    noisy,
    plane_before,
    spots_of,
    variant,
)

from lasercal_gtsam.cell import Camera, Intrinsics
from lasercal_gtsam.closed_form.camera import plane_frames
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.general import PlaneGroups, plane_groups
from lasercal_gtsam.closed_form.one_plane import (
    focal_length_three_rows,
    focal_lengths_two,
    plane_normal,
    plane_normal_paper,
    projected_basis,
    rotations_two_rows,
    solve_one_plane,
    translation_images,
    translations_two_rows,
)
from lasercal_gtsam.closed_form.solution import beam_towards_spots, reprojection
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.rotations import rotation_exp


def solutions(sim, u=None):
    spots = spots_of(sim)
    u = beam_of(sim.truth)[0] if u is None else u
    return {
        name: beam_towards_spots(solution, spots)
        for name, solution in solve_one_plane(groups_of(sim), spots, u, known_centre(sim))
    }


def unequal(fu: float = 560.0, fv: float = 520.0):
    camera = exact("paper-1").truth.cameras["camera"]
    intrinsics = Intrinsics(fu, fv, 0.0, 300.0, 250.0)
    camera = Camera(intrinsics, camera.T_base_camera, camera.image_size)
    return variant(camera=camera, planes={"1": plane_before(camera, 30, 50, 0.3)})


def centred(sim) -> tuple[PlaneGroups, np.ndarray, np.ndarray, np.ndarray]:
    """Homographies about the true principal point; F, R_cb and the plane's frame of the truth."""
    K, R, _ = camera_of(sim.truth)
    spots = spots_of(sim)
    K = spots.scaling @ K
    shift = np.eye(3)
    shift[:2, 2] = -K[:2, 2]
    found = plane_groups(groups_of(sim), beam_of(sim.truth)[0], 1)
    found = PlaneGroups(
        shift @ found.H,
        found.B,
        found.o,
        found.s,
        found.present,
        found.plane,
        found.lines @ np.linalg.inv(shift),
        found.u,
    )
    frame = plane_frames(next(iter(sim.truth.planes.values())).normal_base[None])[0]
    return found, np.diag([K[0, 0], K[1, 1], 1.0]), R.T, frame


@pytest.mark.parametrize("seed", range(3))
def test_all_variants_are_exact_with_equal_focal_lengths(seed):
    sim = exact("paper-1", seed)
    found = solutions(sim)
    assert {"fu and fv (43)", "f, three rows (43)"} <= set(found)
    assert any("root" in name for name in found)
    right = 0
    for name, solution in found.items():
        error = largest_error(solution.to_cell(spots_of(sim), "camera", "laser"), sim.truth)
        if "root" not in name:
            assert error < 1e-8
        right += error < 1e-8
    assert right == 3, "fu and fv, three rows, and one of the two roots"


def test_unequal_focal_lengths_come_from_43():
    sim = unequal()
    cell = solutions(sim)["fu and fv (43)"].to_cell(spots_of(sim), "camera", "laser")
    assert largest_error(cell, sim.truth) < 1e-8


def test_normal_by_differences_and_by_40():
    sim = exact("paper-1")
    found, _, _, frame = centred(sim)
    assert np.linalg.norm(np.cross(plane_normal(found), frame[:, 2])) < 1e-10
    # (40) needs no common scale: spoil it
    P = translation_images(found) * np.array([1.0, -3.0, 0.2])[:, None, None]
    assert np.linalg.norm(np.cross(plane_normal_paper(P, found.beams), frame[:, 2])) < 1e-10


def test_parallel_beams_give_no_normal():
    found, *_ = centred(exact("paper-1"))
    same = replace(found, B=np.repeat(found.B[:1], len(found.B), axis=0))
    with pytest.raises(DegenerateError, match="another direction"):
        plane_normal(same)


def test_projected_basis_is_s_f_r_b():
    """(42): G~ = s F R_cb [b1 b2] with a positive scale."""
    sim = unequal()
    found, F, R_cb, frame = centred(sim)
    basis = projected_basis(found, frame[:, 2], frame[:, :2])
    expected = F @ R_cb @ frame[:, :2]
    s = (basis * expected).sum() / (expected**2).sum()
    assert s > 0
    assert np.allclose(basis, s * expected, atol=1e-10)


def test_43_with_one_one_zero_on_its_right():
    """Corrected (43): A_f x_f = (1, 1, 0)' at the true values."""
    sim = unequal()
    _, F, R_cb, frame = centred(sim)
    s = 0.37
    basis = s * F @ R_cb @ frame[:, :2]
    x = 1.0 / (s * np.diag(F)) ** 2
    A = np.stack([basis[:, 0] ** 2, basis[:, 1] ** 2, basis[:, 0] * basis[:, 1]])
    assert np.allclose(A @ x, [1.0, 1.0, 0.0], atol=1e-13)
    assert np.allclose(focal_lengths_two(basis), (F[0, 0], F[1, 1]))


def test_largest_singular_value_squared_is_sf_squared_and_both_roots_fit():
    """(47), and the corrected (48): both roots have the same upper rows; printed D R D has not."""
    rng = np.random.default_rng(4)
    D = np.diag([1.0, 1.0, -1.0])
    for _ in range(50):
        s, f = rng.uniform(0.1, 3.0, 2)
        R_cb = rotation_exp(rng.normal(size=3))
        frame = rotation_exp(rng.normal(size=3))
        basis = s * np.diag([f, f, 1.0]) @ R_cb @ frame[:, :2]
        block = basis[:2]
        assert np.linalg.eigvalsh(block.T @ block)[1] == pytest.approx((s * f) ** 2, rel=1e-10)
        roots = list(rotations_two_rows(basis, frame))
        assert len(roots) == 2
        for root in roots:
            assert np.allclose(root.T @ root, np.eye(3), atol=1e-7)
            assert np.linalg.det(root) == pytest.approx(1.0)
            assert np.allclose(s * f * (root @ frame[:, :2])[:2], block, atol=1e-7)
        assert min(np.abs(root - R_cb).max() for root in roots) < 1e-6
        printed = D @ roots[0] @ D
        if np.abs(roots[0] - roots[1]).max() > 0.2:
            assert np.abs(s * f * (printed @ frame[:, :2])[:2] - block).max() > 1e-2 * s * f


def test_translation_with_unknown_focal_length():
    """Corrected (53), (54): f, the beam point, the camera and the plane's scale from R_cb alone."""
    sim = exact("paper-1")
    found, F, R_cb, _ = centred(sim)
    tau, T, scale, f = translations_two_rows(found, R_cb)
    _, R, T_true = camera_of(sim.truth)
    _, q = beam_of(sim.truth)
    assert f == pytest.approx(F[0, 0], rel=1e-9)
    assert np.allclose(T, T_true, atol=1e-10)
    assert np.allclose(tau, found.B[0].T @ groups_of(sim).R[0] @ q, atol=1e-10)
    # (54): T_m = R (lambda F^-1 T^_m) + T lies on the plane, in the base
    points = scale * np.linalg.solve(F, found.H[:, :, 2].T).T @ R.T + T
    plane = sim.truth.planes["1"]
    assert np.allclose(points @ plane.normal_base, plane.distance, atol=1e-10)


def test_wrong_root_is_seen_by_its_rms():
    sim = exact("paper-1", 1)
    spots = spots_of(sim)
    rms = sorted(reprojection(s, spots)[0] for n, s in solutions(sim).items() if "root" in n)
    assert rms[0] < 1e-6
    assert len(rms) == 1 or rms[1] > 1.0


def test_plane_parallel_to_the_image_gives_no_focal_length():
    _, _, _, frame = centred(exact("paper-1"))
    flat = frame[:, :2] * 0.8  # camera axes along the base, plane z = const in frame coordinates
    flat = np.vstack([np.eye(2) * 500.0, np.zeros((1, 2))])
    with pytest.raises(DegenerateError, match="tilt the plane"):
        focal_lengths_two(flat)
    with pytest.raises(DegenerateError, match="tilt the plane"):
        focal_length_three_rows(flat)


def test_normal_in_a_coordinate_plane_of_the_camera_ties_fu_to_fv():
    camera = exact("paper-1").truth.cameras["camera"]
    sim = variant(planes={"1": plane_before(camera, 30, 0, 0.3)})
    found = solutions(sim)
    cell = found["f, three rows (43)"].to_cell(spots_of(sim), "camera", "laser")
    assert largest_error(cell, sim.truth) < 1e-8


def test_noise_of_table_1():
    errors = []
    for seed in range(12):
        sim = noisy("paper-1", seed, 0.5)
        u = robust_directions(groups_of(sim))[0][0]
        found = solutions(sim, u)
        best = min(found.values(), key=lambda s: sum(reprojection(s, spots_of(sim))))
        errors.append(abs(best.K[0, 0] / 550.0 - 1.0))
    assert np.median(errors) < 0.08
