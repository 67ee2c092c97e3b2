"""`calibration.json`: the documented format, equality after loading, and what is refused."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lasercal_gtsam.calibration import (
    Calibration,
    Fit,
    Inputs,
    Observability,
    Parameter,
    SpotResults,
    WeakDirection,
)
from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.calibration_file import load_calibration, save_calibration, to_dict
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions

NAN = float("nan")


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def pose(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = random_rotation(rng), rng.standard_normal(3)
    return T


def random_cell(rng: np.random.Generator, names: tuple[str, ...] = ("camera",)) -> Cell:
    return Cell(
        cameras={
            name: Camera(
                Intrinsics(*rng.uniform(500, 900, 2), *rng.standard_normal(7)),
                pose(rng),
                (640, 480),
            )
            for name in names
        },
        lasers={"laser": Beam(rng.standard_normal(3), rng.standard_normal(3))},
        planes={
            name: Plane(rng.standard_normal(3), float(rng.standard_normal()))
            for name in ("1", "2", "table")
        },
    )


LABELS = ("camera.rot_x", "camera.rot_y", "camera.trans_x", "plane 1.distance")


def make(seed: int = 0, spots: int = 5, **changes: Any) -> Calibration:
    """A calibration with numbers of every kind; nothing in it is the result of a fit."""
    rng = np.random.default_rng(seed)
    names = [("1", "2", "table")[k % 3] for k in range(spots)]
    cov = np.tile(np.diag([0.04, 0.09]), (spots, 1, 1))
    cov[::2] = np.nan
    observations = Observations.from_arrays(
        rng.uniform(0, 480, (spots, 2)),
        np.array([pose(rng) for _ in range(spots)]).reshape(-1, 4, 4),
        plane=names,
        image_size={"camera": (640, 480), "spare": (1920, 1200)},
        id=[f"shot {k}" for k in range(spots)],
        cov_uv=cov,
    )
    A = rng.standard_normal((4, 4))
    fields: dict[str, Any] = {
        "cell": random_cell(rng),
        "initial": random_cell(rng),
        "parameters": (
            Parameter("fu", 700.1, 1 / 3, 0.25, "px"),
            Parameter("k1", NAN, -0.1, 0.0, ""),
            Parameter("laser_z", 1e-300, -0.0, math.inf, "mm"),
        ),
        "covariance": A @ A.T,
        "labels": LABELS,
        "fit": Fit(0.1 + 0.2, NAN, 3.5, 7, True, "converged: 5 spots", spots, 1),
        "spots": SpotResults(
            id=observations.id,
            plane=observations.plane,
            camera=observations.camera,
            laser=observations.laser,
            residual_px=rng.standard_normal((spots, 2)),
            weight=rng.uniform(0, 1, spots),
            rejected=("too far: 9 sigma", *[None] * (spots - 1))[:spots],
        ),
        "observability": Observability(
            (WeakDirection(0.01, 'u0 with Tx, "together"'),), ("skew (px)",), ("a note",)
        ),
        "inputs": Inputs(
            observations,
            CalibrationOptions(
                sigma_px=0.5,
                distortion=("k1", "k2"),
                known={"principal_point": (320.0, 240.0), "skew": 0},
                fixed=("plane:1",),
                priors={"fu": (700.0, math.inf)},
            ),
        ),
    }
    return Calibration(**{**fields, **changes})


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    path = tmp_path / "calibration.json"
    make().save(path)
    return path, json.loads(path.read_text())


# --- there and back -----------------------------------------------------------------------------


@settings(
    deadline=None,
    derandomize=True,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32), spots=st.integers(0, 6))
def test_loads_back_to_an_equal_object(tmp_path: Path, seed: int, spots: int) -> None:
    calibration = make(seed, spots)
    save_calibration(calibration, tmp_path / "c.json")
    loaded = load_calibration(tmp_path / "c.json")
    assert loaded == calibration
    assert calibration == loaded
    assert loaded.table() == calibration.table()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(x=st.floats(width=64), y=st.floats(width=64))
def test_any_float_survives(x: float, y: float) -> None:
    from lasercal_gtsam.io.calibration_model import CalibrationModel

    calibration = make(
        parameters=(Parameter("fu", x, y, abs(x), "px"),),
        covariance=np.diag([abs(x), abs(y)]),
        labels=LABELS[:2],
    )
    text = json.dumps(to_dict(calibration), allow_nan=False)
    assert CalibrationModel.model_validate(json.loads(text)).build() == calibration


def test_another_number_anywhere_is_another_calibration(saved: tuple[Path, dict]) -> None:
    path, data = saved
    original = load_calibration(path)
    changes = [
        ("cameras", "camera", "intrinsics", "k1"),
        ("planes", "1", "distance_m"),
        ("lasers", "laser", "point_hand_m", 2),
        ("initial", "cameras", "camera", "T_base_camera", "matrix", 1, 3),
        ("parameters", 0, "initial"),
        ("covariance", "matrix", 2, 1),
        ("fit", "rms_px"),
        ("spots", 3, "residual_px", 0),
        ("observability", "weak", 0, "strength"),
        ("inputs", "observations", "uv", 4, 1),
        ("inputs", "observations", "cov_uv", 1, 0),
        ("inputs", "options", "sigma_px"),
    ]
    for keys in changes:
        changed = json.loads(json.dumps(data))
        inner = changed
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = np.nextafter(inner[keys[-1]], 10.0)
        path.write_text(json.dumps(changed))
        assert load_calibration(path) != original, keys


def test_the_time_of_writing_does_not_count(tmp_path: Path) -> None:
    calibration = make()
    early = to_dict(calibration, created=datetime(2020, 1, 2, 3, 4, 5, tzinfo=UTC))
    late = to_dict(calibration, created=datetime(2021, 1, 2, 3, 4, 5, tzinfo=UTC))
    assert early["provenance"]["created"] == "2020-01-02T03:04:05+00:00"
    assert early != late
    for k, data in enumerate((early, late)):
        (tmp_path / f"{k}.json").write_text(json.dumps(data))
    assert load_calibration(tmp_path / "0.json") == load_calibration(tmp_path / "1.json")


# --- the documented format ----------------------------------------------------------------------


def test_the_documented_keys(saved: tuple[Path, dict]) -> None:
    _, data = saved
    calibration = make()
    assert (data["format"], data["version"]) == ("lasercal-calibration", 1)
    camera = data["cameras"]["camera"]
    assert camera["image_size"] == [640, 480]
    assert list(camera["intrinsics"]) == ["fu", "fv", "skew", "u0", "v0", "k1", "k2", "p1", "p2"]
    assert set(data["lasers"]["laser"]) == {"direction_hand", "point_hand_m"}
    assert set(data["planes"]["1"]) == {"normal_base", "distance_m"}
    assert list(data["parameters"][0]) == ["name", "initial", "refined", "sigma", "unit"]
    assert data["covariance"]["labels"] == list(calibration.labels)
    assert np.shape(data["covariance"]["matrix"]) == (4, 4)
    wanted = ["rms_px", "sigma0", "iterations", "converged", "status", "n_spots", "n_rejected"]
    assert set(wanted) <= set(data["fit"])
    assert {"id", "plane", "residual_px", "weight", "rejected"} <= set(data["spots"][0])
    assert data["spots"][0]["rejected"] == "too far: 9 sigma"
    assert data["spots"][1]["rejected"] is None
    assert {"version", "created", "sha256"} <= set(data["provenance"])
    assert datetime.fromisoformat(data["provenance"]["created"]).utcoffset() == UTC.utcoffset(None)
    assert {"observability", "inputs"} <= set(data)


def test_the_quaternion_is_the_matrix(saved: tuple[Path, dict]) -> None:
    from scipy.spatial.transform import Rotation

    _, data = saved
    stored = data["cameras"]["camera"]["T_base_camera"]
    T = make().cell.cameras["camera"].T_base_camera
    w, x, y, z = stored["quat_wxyz"]
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), T[:3, :3], atol=1e-14)
    assert stored["translation_m"] == T[:3, 3].tolist()


def test_the_file_is_standard_json(saved: tuple[Path, dict]) -> None:
    path, data = saved

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    assert json.loads(path.read_text(), parse_constant=refuse) == data
    assert data["parameters"][1]["initial"] is None
    assert data["parameters"][2]["sigma"] == "inf"
    assert data["fit"]["sigma0"] is None
    # rows of numbers stay on one line, for people who look at differences between two files
    assert max(map(len, path.read_text().splitlines())) < 600


def test_hash_of_the_inputs_names_the_inputs_alone() -> None:
    one, two = to_dict(make(1)), to_dict(make(1, cell=random_cell(np.random.default_rng(9))))
    other = to_dict(make(2))
    assert one["provenance"]["sha256"] == two["provenance"]["sha256"]
    assert one["provenance"]["sha256"] != other["provenance"]["sha256"]


def test_sources_are_noted(tmp_path: Path) -> None:
    save_calibration(make(), tmp_path / "c.json", sources={"poses.csv": "ab12"})
    assert json.loads((tmp_path / "c.json").read_text())["provenance"]["files"] == {
        "poses.csv": "ab12"
    }


def test_a_pose_edited_by_hand(saved: tuple[Path, dict]) -> None:
    path, data = saved
    stored = data["cameras"]["camera"]["T_base_camera"]
    stored["translation_m"] = [1.0, 2.0, 3.0]
    stored["quat_wxyz"] = [0, 0, 0, 1]
    path.write_text(json.dumps(data))
    with pytest.raises(DataError, match=r"cameras\.camera\.T_base_camera: .*remove matrix"):
        load_calibration(path)
    del stored["matrix"]
    path.write_text(json.dumps(data))
    T = load_calibration(path).cell.cameras["camera"].T_base_camera
    np.testing.assert_allclose(
        T, [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15
    )


def test_a_later_version_may_add_keys(saved: tuple[Path, dict]) -> None:
    path, data = saved
    data["colour"] = "blue"
    data["cameras"]["camera"]["serial"] = 7
    path.write_text(json.dumps(data))
    assert load_calibration(path) == make()


# --- what is refused ----------------------------------------------------------------------------


def refusal(path: Path) -> tuple[str, ...]:
    with pytest.raises(DataError) as caught:
        load_calibration(path)
    return caught.value.problems


def test_missing_and_wrong_keys_all_at_once(saved: tuple[Path, dict]) -> None:
    path, data = saved
    del data["cameras"]["camera"]["intrinsics"]["fu"]
    del data["fit"]["status"]
    data["planes"]["2"]["normal_base"] = [1, 2]
    data["lasers"]["laser"]["point_hand_m"] = "here"
    data["parameters"][1]["refined"] = "big"
    data["inputs"]["observations"]["T_base_hand"][0] = [1, 2, 3]
    path.write_text(json.dumps(data))
    problems = "\n".join(refusal(path))
    assert "cameras.camera.intrinsics.fu: left out" in problems
    assert "fit.status: left out" in problems
    assert "planes.2.normal_base: expected numbers of shape (3), got shape (2,)" in problems
    assert "lasers.laser.point_hand_m: expected a list of numbers" in problems
    assert "parameters.1.refined: expected a valid number, got 'big'" in problems
    assert "inputs.observations.T_base_hand: expected numbers of shape (N, 16)" in problems
    assert len(problems.splitlines()) == 6
    assert all(line.startswith(f"{path}: ") for line in problems.splitlines())


def test_values_that_make_no_cell_all_at_once(saved: tuple[Path, dict]) -> None:
    path, data = saved
    data["cameras"]["camera"]["intrinsics"]["fu"] = -1
    data["initial"]["planes"]["1"]["normal_base"] = [0, 0, 0]
    data["inputs"]["options"]["robust"] = "hubert"
    data["inputs"]["observations"]["id"].pop()
    path.write_text(json.dumps(data))
    problems = refusal(path)
    assert [p.removeprefix(f"{path}: ").split(":")[0] for p in problems] == [
        "cameras.camera",
        "initial.planes.1",
        "inputs.observations",
        "inputs.options",
    ]


def test_numbers_whose_squares_are_none(saved: tuple[Path, dict]) -> None:
    path, data = saved
    intrinsics = data["cameras"]["camera"]["intrinsics"]
    intrinsics["u0"] = 1e-300
    path.write_text(json.dumps(data))
    assert load_calibration(path).cell.cameras["camera"].intrinsics.u0 == 0.0
    intrinsics["u0"] = 1e300
    path.write_text(json.dumps(data))
    assert "cameras.camera.intrinsics.u0: expected a number up to 1e+12" in refusal(path)[0]


def test_unknown_option(saved: tuple[Path, dict]) -> None:
    path, data = saved
    data["inputs"]["options"]["sigma_pix"] = 1.0
    path.write_text(json.dumps(data))
    assert "did you mean 'sigma_px'" in refusal(path)[0]


def test_covariance_must_fit_its_labels(saved: tuple[Path, dict]) -> None:
    path, data = saved
    data["covariance"]["labels"].pop()
    path.write_text(json.dumps(data))
    assert "expected shape (3, 3), got (4, 4)" in refusal(path)[0]


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(2, 2, -1.0), (2, 2, "-inf"), (0, 1, 1e3), (0, 1, 1e308), (3, 3, 0.0), (1, 1, 1e-9)],
)
def test_what_is_no_covariance(
    saved: tuple[Path, dict], row: int, column: int, value: float | str
) -> None:
    path, data = saved
    matrix = data["covariance"]["matrix"]
    matrix[row][column] = matrix[column][row] = value
    path.write_text(json.dumps(data))
    assert "covariance.matrix: expected a symmetric matrix without" in refusal(path)[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "the file is empty"),
        ('{"format": "lasercal-calibration",\n "version": 1,,}', ":2:15: not JSON"),
        ("[1, 2]", "expected a mapping with format 'lasercal-calibration', got a list"),
        ('{"format": "yaml"}', "expected a mapping with format 'lasercal-calibration', got 'yaml'"),
        ('{"format": "lasercal-calibration", "version": 2}', "use a newer lasercal-gtsam"),
        ('{"format": "lasercal-calibration"}', "version None of the format"),
    ],
)
def test_other_files(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(text)
    (problem,) = refusal(path)
    assert expected in problem
    assert problem.startswith(str(path))


@pytest.mark.parametrize("kind", ["camera", "laser", "plane"])
def test_spots_of_parts_that_the_cell_does_not_have(
    saved: tuple[Path, dict[str, Any]], kind: str
) -> None:
    path, data = saved
    names = data["inputs"]["observations"][kind]
    names[:] = [names] if isinstance(names, str) else names
    names[-1] = "elsewhere"
    if kind == "camera":
        data["inputs"]["observations"]["image_size"]["elsewhere"] = [640, 480]
    path.write_text(json.dumps(data))
    assert (
        f"inputs.observations.{kind}: 'elsewhere' is used, but not in the cell" in refusal(path)[0]
    )


def test_missing_file(tmp_path: Path) -> None:
    assert "there is no such file" in refusal(tmp_path / "none.json")[0]


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    make(1).save(path)
    broken = make(2, labels=("a",), covariance=np.array([[1.0]]))
    object.__setattr__(broken.inputs.options, "known", {"skew": object()})
    with pytest.raises(TypeError):
        broken.save(path)
    assert load_calibration(path) == make(1)
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be written: there is no such file or folder"):
        make().save(tmp_path / "nowhere" / "c.json")
