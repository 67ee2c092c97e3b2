"""`lasercal export`, and `lasercal calibrate --intrinsics`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_support import Cli, contents, environment
from format_cases import CAMERA, calibrated, skewed, two_cameras

import lasercal_gtsam as lc
from lasercal_gtsam.formats.registry import FORMATS
from lasercal_gtsam.io.capture_writer import write_capture


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture with its calibration."""
    folder = tmp_path_factory.mktemp("cell")
    write_capture(
        folder, calibrated().inputs.observations, transform="T_base_hand", length="mm",
        rotation="quat_wxyz", with_spots=True, known={"skew": 0},
    )  # fmt: skip
    calibrated().save(folder / "calibration.json")
    return folder


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_is_written_beside_the_calibration(cli, form, tmp_path):
    source = tmp_path / "cal.json"
    calibrated().save(source)
    outcome = cli("export", source, form)
    assert outcome.status == 0, outcome.err
    (written,) = [p for p in tmp_path.iterdir() if p != source]
    camera = "camera-" if FORMATS[form].of == "camera" else ""
    assert written.name == f"cal-{camera}{form}{FORMATS[form].ending}"
    assert f"Wrote {written}" in outcome.out
    assert "Traceback" not in outcome.err


def test_it_says_where_the_numbers_come_from(cli, folder, tmp_path):
    target = tmp_path / "x.urdf"
    chosen = ("-o", target, "--parent", "robot", "--child", "eye")
    document = cli.json("export", folder / "calibration.json", "urdf", *chosen)
    assert document["path"] == str(target)
    assert document["format"] == "urdf"
    assert document["bytes"] == target.stat().st_size
    text = target.read_text()
    assert "calibration.json, SHA-256" in text
    assert '<parent link="robot"/>' in text
    assert '<child link="eye"/>' in text


def test_text_goes_to_standard_output(cli, folder):
    before = contents(folder)
    outcome = cli("export", folder / "calibration.json", "ros-pose", "-o", "-")
    assert yaml.safe_load(outcome.out)["header"] == {"frame_id": "base"}
    assert contents(folder) == before
    both = cli("export", folder / "calibration.json", "ros-pose", "-o", "-", "--json")
    assert both.status == 2


def test_a_file_that_is_there_stays_unless_forced(cli, folder, tmp_path):
    target = tmp_path / "mine.yaml"
    target.write_text("mine")
    outcome = cli("export", folder / "calibration.json", "kalibr", "-o", target)
    assert outcome.status == 1
    assert "--force" in outcome.err
    assert target.read_text() == "mine"
    assert cli("export", folder / "calibration.json", "kalibr", "-o", target, "--force").status == 0
    assert "cam0" in target.read_text()


def test_mistakes_are_said_in_a_line(cli, folder, tmp_path):
    source = folder / "calibration.json"
    assert cli("export", source, "kalibrr").status == 2
    for args, words in [
        ((tmp_path / "none.json", "urdf"), "no such file"),
        ((source, "urdf", "--camera", "left", "-o", tmp_path / "x"), "'left' is not among them"),
        ((source, "urdf", "--child", "/x", "-o", tmp_path / "x"), "not beginning with a slash"),
        ((source, "urdf", "-o", tmp_path / "no" / "x"), "there is no folder"),
    ]:
        outcome = cli("export", *args)
        assert outcome.status == 1
        assert words in outcome.err
        assert "Traceback" not in outcome.err
        assert not (tmp_path / "x").exists()


def test_a_skew_is_refused_or_fitted_again(cli, tmp_path):
    skewed().save(tmp_path / "s.json")
    refused = cli("export", tmp_path / "s.json", "mrcal")
    assert refused.status == 1
    assert "--skew refit" in refused.err
    assert len(list(tmp_path.iterdir())) == 1
    done = cli("export", tmp_path / "s.json", "mrcal", "--skew", "refit")
    assert done.status == 0
    assert "fitted again with the skew held at 0" in done.err


def test_the_help_lists_every_format(cli):
    shown = cli("export", "--help").out
    for form in FORMATS.values():
        assert f"{form.name} " in shown
        assert form.summary in shown


def test_the_help_is_there_at_once():
    program = (
        "import sys; from lasercal_gtsam.cli.main import main; main(['export', '-h']); "
        "heavy = {'gtsam', 'numba', 'cv2', 'scipy', 'ruamel', 'pydantic'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment(),
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


# --- lenses from elsewhere ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def lenses(tmp_path_factory):
    """Files of a lens: without a covariance, with one, and of two cameras."""
    folder = tmp_path_factory.mktemp("lenses")
    lc.export(calibrated(), "ros-camera-info", folder / "ros.yaml")
    lc.export(calibrated(), "opencv", folder / "opencv.yaml")
    lc.export(two_cameras(), "kalibr", folder / "chain.yaml")
    return folder


def calibrate(cli, folder, tmp_path, *args):
    outcome = cli("calibrate", folder, "-o", tmp_path / "out.json", *args)
    assert outcome.status == 0, outcome.err
    return lc.load_calibration(tmp_path / "out.json"), outcome


def test_a_lens_is_held(cli, folder, lenses, tmp_path):
    found, outcome = calibrate(cli, folder, tmp_path, "--intrinsics", lenses / "ros.yaml")
    wanted = calibrated().cell.cameras[CAMERA].intrinsics
    np.testing.assert_array_equal(found.cell.cameras[CAMERA].intrinsics.vector, wanted.vector)
    assert "held at the known value" in outcome.out
    again, _ = calibrate(
        cli, folder, tmp_path, "--intrinsics", f"camera={lenses / 'chain.yaml'}@cam0",
        "--known", "fu=555",
    )  # fmt: skip
    assert again.cell.cameras[CAMERA].intrinsics.fu == 555  # what is said by name wins
    assert again.cell.cameras[CAMERA].intrinsics.u0 == wanted.u0


def test_a_lens_is_a_prior(cli, folder, lenses, tmp_path):
    given = ("--intrinsics", lenses / "opencv.yaml", "--intrinsics-as", "prior")
    found, outcome = calibrate(cli, folder, tmp_path, *given)
    assert "claim no more than its covariance" in outcome.err
    assert "alpha_c not used: known already" in outcome.err
    assert 0 < found["fu"].sigma < calibrated()["fu"].sigma
    refused = cli(
        "calibrate", folder, "-o", tmp_path / "no.json", "--intrinsics", lenses / "ros.yaml",
        "--intrinsics-as", "prior",
    )  # fmt: skip
    assert refused.status == 1
    assert "--intrinsics-sigma" in refused.err
    sigmas = [f"{k}=1" for k in ("fu", "fv", "u0", "v0")]
    sigmas += [f"{k}=0.01" for k in ("k1", "k2", "p1", "p2")]
    options = [word for pair in sigmas for word in ("--intrinsics-sigma", pair)]
    stated, _ = calibrate(
        cli, folder, tmp_path, "--intrinsics", lenses / "ros.yaml", "--intrinsics-as", "prior",
        *options,
    )  # fmt: skip
    assert 0 < stated["fu"].sigma < 1.1


def test_a_lens_is_a_start(cli, folder, lenses, tmp_path):
    given = ("--intrinsics", lenses / "ros.yaml", "--intrinsics-as", "start")
    found, _ = calibrate(cli, folder, tmp_path, *given)
    assert found["fu"].refined == pytest.approx(
        calibrated()["fu"].refined, abs=0.01 * calibrated()["fu"].sigma
    )
    assert found["fu"].sigma == pytest.approx(calibrated()["fu"].sigma, rel=0.01)


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (["--intrinsics", "{}/none.yaml"], 1, "no such file"),
        (["--intrinsics", "{}/chain.yaml"], 1, "cam0, cam1; none was named"),
        (["--intrinsics", "left={}/ros.yaml"], 1, "given for camera 'left'"),
        (["--intrinsics", "{}/ros.yaml", "--intrinsics", "{}/ros.yaml"], 1, "a lens twice"),
        (["--intrinsics-as", "prior"], 2, "need --intrinsics FILE"),
        (["--intrinsics", "{}/ros.yaml", "--intrinsics-sigma", "fu=1"], 2, "goes with"),
        (
            ["--intrinsics", "{}/ros.yaml", "--intrinsics-as", "prior",
             "--intrinsics-sigma", "f=1"], 2, "expected one of fu, fv",
        ),
    ],
)  # fmt: skip
def test_wrong_lenses_are_refused(cli, folder, lenses, tmp_path, args, status, words):
    said = [arg.format(lenses) for arg in args]
    outcome = cli("calibrate", folder, "-o", tmp_path / "x.json", *said)
    assert outcome.status == status
    assert words in outcome.err
    assert not (tmp_path / "x.json").exists()


def test_the_page_on_formats_has_every_format():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    table = [line for line in page.splitlines() if line.startswith("| `")]
    assert {word for line in table for word in line.split("`")[1::2]} >= set(FORMATS)
