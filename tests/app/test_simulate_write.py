"""A simulation on disk reads back as the same observations, in every convention."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import load_capture
from lasercal_gtsam.simulate import (
    Noise,
    load_truth,
    simulate,
    simulate_cell,
    write_simulation,
)
from lasercal_gtsam.simulate.cells import paper_cell
from lasercal_gtsam.simulate.pictures import PictureOptions, render_pictures
from lasercal_gtsam.simulate.render import RenderOptions

ROTATIONS = [
    "quat_wxyz",
    "quat_xyzw",
    "matrix",
    "rotvec_rad",
    "rotvec_deg",
    "euler:ZYZ:deg",
    "euler:xyz:rad",
    "staubli",
    "kuka",
    "fanuc",
    "yaskawa",
    "abb",
    "ur",
    "kawasaki",
    "mitsubishi",
]


def small(noise=None, seed=0):
    return simulate_cell(paper_cell(2), groups=1, shots=2, noise=noise, seed=seed)


@pytest.mark.parametrize("rotation", ROTATIONS)
@pytest.mark.parametrize(
    ("transform", "length"), [("T_base_hand", "mm"), ("T_hand_base", "m"), ("T_hand_base", "mm")]
)
def test_a_written_capture_reads_back(tmp_path, rotation, transform, length):
    simulation = simulate("paper-2", 4, Noise.table1(0.5))
    file = write_simulation(
        tmp_path / "new", simulation, rotation=rotation, transform=transform, length=length
    )
    capture = load_capture(file)
    read, made = capture.observations(), simulation.observations
    np.testing.assert_array_equal(read.uv, made.uv)
    np.testing.assert_allclose(read.T_base_hand, made.T_base_hand, atol=1e-14)
    for name in ("id", "plane", "camera", "laser"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert read.image_size == made.image_size
    assert np.isnan(read.cov_uv).all() and np.isnan(made.cov_uv).all()


def test_plain_conventions_lose_nothing(tmp_path):
    simulation = simulate("no-groups", 1)
    file = write_simulation(tmp_path, simulation, rotation="matrix", length="m")
    assert load_capture(file).observations() == simulation.observations


def test_noise_and_known_values_are_stated(tmp_path):
    noise = Noise.table1(0.5)
    capture = load_capture(write_simulation(tmp_path / "a", simulate("paper-1", 0, noise)))
    assert capture.noise.sigma_px == pytest.approx(0.5)
    assert capture.noise.hand_sigma_m == pytest.approx(0.5e-3)
    assert capture.noise.hand_sigma_rad == pytest.approx(np.radians(0.025))
    assert capture.known == {"principal_point": (320.0, 240.0), "skew": 0.0}
    silent = load_capture(
        write_simulation(tmp_path / "b", simulate("paper", 0, noise), state_noise=False)
    )
    assert (silent.noise.sigma_px, silent.noise.hand_sigma_m) == (None, 0.0)
    assert silent.known == {}


def test_the_truth_lies_beside_the_capture(tmp_path):
    simulation = simulate("table2-4", 2, Noise.table1())
    write_simulation(tmp_path, simulation)
    truth = json.loads((tmp_path / "truth.json").read_text())
    cell = simulation.truth
    assert truth["cameras"]["camera"]["intrinsics"] == {
        name: getattr(cell.cameras["camera"].intrinsics, name)
        for name in ("fu", "fv", "skew", "u0", "v0", "k1", "k2", "p1", "p2")
    }
    assert truth["cameras"]["camera"]["image_size"] == [640, 480]
    pose = truth["cameras"]["camera"]["T_base_camera"]
    w, x, y, z = pose["quat_wxyz"]
    angle = 2 * np.arctan2(np.linalg.norm([x, y, z]), w)
    R, _ = cv2.Rodrigues(angle * np.array([x, y, z]) / np.linalg.norm([x, y, z]))
    np.testing.assert_allclose(R, cell.cameras["camera"].T_base_camera[:3, :3], atol=1e-14)
    assert pose["translation_m"] == cell.cameras["camera"].T_base_camera[:3, 3].tolist()
    assert truth["lasers"]["laser"]["point_hand_m"] == [0.0, -0.041, 0.063]
    assert truth["lasers"]["laser"]["direction_hand"] == (
        cell.lasers["laser"].direction_hand.tolist()
    )
    assert list(truth["planes"]) == ["1", "2"]
    for name, plane in truth["planes"].items():
        assert plane["normal_base"] == cell.planes[name].normal_base.tolist()
        assert plane["distance_m"] == cell.planes[name].distance
    assert [spot["id"] for spot in truth["spots"]] == list(simulation.observations.id)
    noise = [spot["uv_px"] for spot in truth["spots"]] - simulation.observations.uv
    assert 0.8 < noise.std() < 1.2  # pixel noise alone lies between truth and data
    assert (truth["preset"], truth["seed"]) == ("table2-4", 2)


def test_the_truth_reads_back_exactly(tmp_path):
    simulation = simulate("paper", 3)
    write_simulation(tmp_path, simulation)
    assert load_truth(tmp_path) == load_truth(tmp_path / "truth.json") == simulation.truth


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "truth.json:1:2: not JSON"),
        ('{"format": "lasercal-calibration"}', "lasercal-truth"),
        ('{"format": "lasercal-truth", "cameras": {}, "lasers": {}}', "truth.json: planes"),
    ],
)
def test_what_is_no_truth_is_refused(tmp_path, text, match):
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(DataError, match=match):
        load_truth(tmp_path)
    with pytest.raises(DataError, match="no such file"):
        load_truth(tmp_path / "other.json")


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (16, np.uint16)])
def test_pictures_are_written_on_and_off(tmp_path, bits, dtype):
    simulation = small(Noise.table1(0.5))
    calls = []
    options = PictureOptions(RenderOptions(bits=bits))
    file = write_simulation(
        tmp_path,
        simulation,
        spots=False,
        pictures=options,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    capture = load_capture(file)
    assert np.isnan(capture.uv).all()
    assert capture.noise.sigma_px is None  # the pictures have their own
    assert capture.noise.hand_sigma_m == pytest.approx(0.5e-3)
    for shot, on, off in zip(
        render_pictures(simulation, options), capture.images_on, capture.images_off, strict=True
    ):
        for path, picture in ((on, shot.on), (off, shot.off)):
            read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert read.dtype == dtype
            np.testing.assert_array_equal(read, picture)


def test_the_spot_is_where_the_truth_says():
    clean = RenderOptions(
        bits=16,
        speckle_contrast=0.0,
        skirt_fraction=0.0,
        texture=0.0,
        patches=0,
        highlights=0,
        ghost_probability=0.0,
        flicker=0.0,
        jitter_px=0.0,
        full_well_e=1e7,
    )
    simulation = small(Noise.table1())
    pictures = render_pictures(simulation, PictureOptions(clean, beam_radius_m=2e-3))
    for shot, uv in zip(pictures, simulation.uv_true, strict=True):
        light = shot.on.astype(float) - shot.off
        light[light < 0.01 * light.max()] = 0
        v, u = np.mgrid[: light.shape[0], : light.shape[1]]
        centre = [(light * u).sum() / light.sum(), (light * v).sum() / light.sum()]
        np.testing.assert_allclose(centre, uv, atol=0.02)


def test_a_picture_depends_on_seed_and_place_only():
    simulation = small()
    one, two = list(render_pictures(simulation)), list(render_pictures(simulation))
    assert all(
        np.array_equal(a.on, b.on) and np.array_equal(a.off, b.off)
        for a, b in zip(one, two, strict=True)
    )
    assert not np.array_equal(one[0].off, one[1].off)  # noise is drawn anew
    same_plane = np.corrcoef(one[0].off.ravel(), one[1].off.ravel())[0, 1]
    other_plane = np.corrcoef(one[0].off.ravel(), one[2].off.ravel())[0, 1]
    assert same_plane > 0.5 > abs(other_plane)


def test_laser_on_pictures_alone(tmp_path):
    write_simulation(tmp_path, small(), spots=False, pictures=PictureOptions(off=False))
    assert sorted(p.name for p in (tmp_path / "images").iterdir()) == [
        "s001.png",
        "s002.png",
        "s003.png",
        "s004.png",
    ]
    assert load_capture(tmp_path).images_off == (None,) * 4


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="not empty"):
        write_simulation(tmp_path, small())
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(DataError, match="cannot be written"):
        write_simulation(tmp_path / "notes.txt" / "below", small())


@pytest.mark.parametrize(
    ("request_", "match"),
    [
        ({"rotation": "quaternion"}, "quat_wxyz"),
        ({"length": "cm"}, "mm or m"),
        ({"transform": "base_hand"}, "T_base_hand or T_hand_base"),
        ({"spots": False}, "spots or images"),
    ],
)
def test_a_wrong_request_writes_nothing(tmp_path, request_, match):
    with pytest.raises(DataError, match=match):
        write_simulation(tmp_path, small(), **request_)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_leaves_nothing(tmp_path):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulation(tmp_path, small(), pictures=PictureOptions(), progress=stop)
    assert list(tmp_path.iterdir()) == []
