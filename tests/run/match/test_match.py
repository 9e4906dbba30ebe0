"""`slam match`: plain pictures in pixels, calibrated ones in metres, and a plain no."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import cv2
import floor_pictures
import numpy as np
import pytest
from click.testing import CliRunner

from slamcli.cli.main import main
from slamcli.core.config import FeatureOptions, MatchOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import View
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image
from slamcli.run.match import fitting
from slamcli.stages import local_correlation

SCALE, DEGREES = 0.8, 25.0


def run(*arguments):
    return CliRunner().invoke(main, ["match", *map(str, arguments)], catch_exceptions=False)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two pictures of one floor by a known similarity, a third of another floor."""
    folder = tmp_path_factory.mktemp("Bilder für Übung")
    first = floor_pictures.asphalt(500)
    radians = math.radians(DEGREES)
    cosine, sine = SCALE * math.cos(radians), SCALE * math.sin(radians)
    second_from_first = np.array([[cosine, -sine, 150.0], [sine, cosine, -20.0]])
    second = cv2.warpAffine(first, second_from_first, (520, 480), flags=cv2.INTER_AREA)
    write_image(folder / "first picture.png", first)
    write_image(folder / "second.png", second)
    write_image(folder / "other.png", floor_pictures.asphalt(200, seed=99))
    return folder


def test_plain_pictures_in_image_axes(pictures, tmp_path):
    drawing = tmp_path / "match.png"
    result = run(pictures / "first picture.png", pictures / "second.png", "-o", drawing, "--json")
    assert result.exit_code == 0
    facts = json.loads(result.stdout)
    assert facts["fits"] is True
    assert facts["model"] == "similarity"
    assert facts["unit"] == "px"
    assert facts["scale"] == pytest.approx(SCALE, rel=1e-3)
    assert facts["rotation_degrees"] == pytest.approx(DEGREES, abs=0.05)
    assert facts["translation"] == pytest.approx([150.0, -20.0], abs=0.3)
    assert facts["correlation"] > 0.8
    shown = cv2.imread(str(drawing))
    green = np.all(shown == (60, 200, 40), axis=2)
    assert green.sum() > 500


@pytest.mark.parametrize("method", ["orb", "sift"])
@pytest.mark.parametrize("model", ["similarity", "affine", "homography"])
def test_models_and_methods_agree(pictures, model, method):
    arguments = ("--model", model, "--features", method, "--count", 1500, "--json")
    result = run(pictures / "first picture.png", pictures / "second.png", *arguments)
    assert result.exit_code == 0
    facts = json.loads(result.stdout)
    matrix = np.array(facts["second_from_first"])
    centre = matrix @ (250.0, 250.0, 1.0)
    cosine, sine = (SCALE * f(math.radians(DEGREES)) for f in (math.cos, math.sin))
    expected = (250 * (cosine - sine) + 150.0, 250 * (sine + cosine) - 20.0)
    assert centre[:2] / centre[2] == pytest.approx(expected, abs=0.3)
    assert ("scale" in facts) == (model == "similarity")


def test_a_rigid_model_cannot_fit_another_scale(pictures):
    result = run(
        pictures / "first picture.png",
        pictures / "second.png",
        "--model",
        "rigid",
        "--features",
        "orb",
    )
    assert result.exit_code == 1
    assert "no fit" in result.stdout.splitlines()[-1]


def test_different_scenes_are_rejected_in_one_line(pictures, tmp_path):
    drawing = tmp_path / "no.png"
    result = run(pictures / "first picture.png", pictures / "other.png", "-o", drawing)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert lines[0] == "no calibration: pixel units"
    assert lines[1].startswith("no fit (")
    assert "needed" in lines[1]
    assert drawing.exists()


def test_a_fit_that_the_pixels_contradict_is_rejected(pictures, monkeypatch):
    for correlation, words in ((0.1, "do not look alike"), (math.nan, "too little to confirm")):
        monkeypatch.setattr(
            local_correlation, "local_correlation", lambda *_, value=correlation: value
        )
        result = run(pictures / "first picture.png", pictures / "second.png", "--features", "orb")
        assert result.exit_code == 1
        assert words in result.stdout


def test_few_inliers_are_accepted_only_where_the_pixels_agree_well(monkeypatch):
    recipes = fitting.AUTO_RECIPES[:1] * 2
    for correlation, accepted in ((0.5, False), (0.75, True)):
        fit = fitting.PairFit(recipes[0], SimpleNamespace(inlier_count=8), (), (), correlation, "")
        monkeypatch.setattr(fitting, "_fit_by", lambda *_, fit=fit: fit)
        monkeypatch.setattr(fitting, "_affordable", lambda *_: True)
        found = fitting.fit_pair(None, None, recipes, FeatureOptions(), MatchOptions())
        assert (not found.reason) == accepted


def test_windows_agree_only_under_the_true_motion():
    # Half of the second view is an empty canvas, and it is darker: neither may matter.
    floor = floor_pictures.asphalt(1200)
    motion = Pose2(40.0, 25.0, 0.4)
    first = floor_pictures.look(floor, Pose2())
    second = floor_pictures.look(floor, motion, seed=1)
    image = (second.image * 0.7).astype(np.uint8)
    image[:, 300:] = 255
    second = View(second.grid, image, second.mask)
    assert local_correlation.local_correlation(first, second, motion.matrix) > 0.9
    assert (
        abs(local_correlation.local_correlation(first, second, (motion @ Pose2(12.0)).matrix)) < 0.3
    )
    flat = View(second.grid, np.full_like(image, 100), second.mask)
    assert math.isnan(local_correlation.local_correlation(first, flat, motion.matrix))
    assert math.isnan(local_correlation.local_correlation(first, second, Pose2(5000.0).matrix))


def test_calibrated_pictures_in_metres(tmp_path):
    # The robot drives 6 cm ahead and 1 cm left, and turns 4 degrees left.
    truth = Pose2(0.06, 0.01, math.radians(4.0))
    calibration = floor_pictures.forward_camera()
    floor = floor_pictures.asphalt(2600)
    grid = Grid(-0.1, 0.65, 0.0005, 2600, 2600)
    for name, pose in (("a.png", Pose2()), ("b.png", truth)):
        write_image(tmp_path / name, floor_pictures.photograph(floor, grid, calibration, pose))
    save_calibration(tmp_path / "camera.yaml", calibration)
    arguments = (tmp_path / "a.png", tmp_path / "b.png", "-c", tmp_path / "camera.yaml")
    result = run(*arguments, "--json")
    assert result.exit_code == 0
    facts = json.loads(result.stdout)
    assert facts["model"] == "rigid"
    assert facts["unit"] == "m"
    moved = facts["first_from_second"]
    assert moved["x"] == pytest.approx(truth.x, abs=3e-4)
    assert moved["y"] == pytest.approx(truth.y, abs=3e-4)
    assert moved["heading_degrees"] == pytest.approx(4.0, abs=0.04)
    assert moved["sigma_x"] < 3e-4
    np.testing.assert_allclose(
        facts["second_from_first"], truth.inverse().matrix, atol=1e-3, rtol=0
    )
    printed = run(*arguments, "-o", tmp_path / "match.png").stdout
    assert "the robot moved x 0.0" in printed
    assert "mm" in printed


def test_equal_runs_print_equal_bytes(pictures):
    arguments = (pictures / "first picture.png", pictures / "second.png", "--json")
    assert run(*arguments).stdout == run(*arguments).stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("first picture.png", "missing.png"), "missing.png does not exist"),
        (("first picture.png", "."), "must be two image files, not folders"),
        (("first picture.png", "broken.png"), "broken.png: the file is empty"),
        (("first picture.png", "second.png", "-o", "match.txt"), "name it .png or .jpg"),
        (("first picture.png", "second.png", "--first-level", "9"), "needs more than 8 levels"),
        (("first picture.png", "second.png", "-o", "second.png"), "is an input of this command"),
    ],
)
def test_what_cannot_be_used_is_one_line(pictures, monkeypatch, arguments, message):
    monkeypatch.chdir(pictures)
    (pictures / "broken.png").write_bytes(b"")
    before = (pictures / "second.png").read_bytes()
    result = run(*arguments)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    assert (pictures / "second.png").read_bytes() == before
