"""Bundle adjustment: derivatives, patch tracking, what is recovered and what is not observable."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from matched_drives import drive, observe
from numpy.typing import NDArray
from trajectories import compare, read_poses

from slamcli.cli.main import main
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.mounting import rocked
from slamcli.core.camera.projection import project_floor
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.io.calibrations import (
    CalibrationSource,
    load_calibration,
    load_origin,
    save_calibration,
)
from slamcli.run.self_calibration import true_scale
from slamcli.simulation.config import CameraOptions
from slamcli.simulation.photograph import make_camera
from slamcli.stages import adjustment
from slamcli.stages.adjustment.frame_poses import MountedFrames
from slamcli.stages.adjustment.projection import transfer_with_jacobians
from slamcli.stages.calibrate import square_target

FREE = np.array([True, True, False, True, True, False, False])
STILL = np.zeros(3)
WRONG = np.array([math.log(1.05), 0.2, 0.0, math.radians(2.0), 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def true_camera() -> Calibration:
    return make_camera(CameraOptions(k1=-0.2, roll_degrees=1.0))


def errors(found: Calibration, true: Calibration) -> NDArray[np.float64]:
    """Return the errors of log focal length, k1, k2, pitch, roll and principal point."""
    return np.array(
        [
            math.log(found.camera_matrix[0, 0] / true.camera_matrix[0, 0]),
            *(found.distortion[:2] - true.distortion[:2]),
            found.pitch_radians - true.pitch_radians,
            found.roll_radians - true.roll_radians,
            *(found.camera_matrix[:2, 2] - true.camera_matrix[:2, 2]) / true.camera_matrix[0, 0],
        ]
    )


def adjusted(
    start: Calibration, poses: dict[int, Pose2], matches: list[adjustment.Matches], *, rocking: bool
) -> adjustment.Adjustment:
    generator = np.random.default_rng(6)
    frame_poses = {
        index: adjustment.FramePose(
            pose @ Pose2(*generator.normal(0.0, 0.005, 3)) if index else pose, Rocking()
        )
        for index, pose in poses.items()
    }
    return adjustment.adjust(
        start,
        frame_poses,
        matches,
        [0],
        camera_free=FREE,
        rocking_sigmas=adjustment.INITIAL_ROCKING_SIGMAS if rocking else STILL,
        learning_rounds=5 if rocking else 0,
    )


@pytest.mark.parametrize(
    ("model", "nadir"), [("plumb_bob", False), ("equidistant", False), ("plumb_bob", True)]
)
def test_the_derivatives_are_those_of_the_transfer(
    true_camera: Calibration, model: str, nadir: bool
) -> None:
    calibration = replace(
        true_camera,
        distortion_model=model,  # type: ignore[arg-type]
        distortion=np.array([-0.1, 0.02, 0.0, 0.0]),
    )
    if nadir:
        above = replace(calibration, pitch_radians=1.55, roll_radians=-0.03, ahead_radians=0.7)
        calibration = rocked(above, Rocking())
    a = adjustment.FramePose(Pose2(1.0, 2.0, 0.3), Rocking(0.01, -0.02, 0.01))
    b = adjustment.FramePose(Pose2(1.1, 2.05, 0.5), Rocking(-0.01, 0.01, 0.003))
    pixels = np.random.default_rng(0).uniform([100, 200], [500, 450], (20, 2))
    mounted = (MountedFrames.of(calibration, [pose]) for pose in (a, b))
    found = transfer_with_jacobians(calibration, *mounted, pixels)
    small = 1e-6

    def moved(pose: adjustment.FramePose, number: int, by: float) -> adjustment.FramePose:
        change = np.zeros(6)
        change[number] = by
        height = calibration.height_metres + pose.rocking.height_metres
        return adjustment.FramePose(
            pose.map_from_robot @ Pose2(*change[:3]),
            Rocking(
                pose.rocking.pitch_radians + change[3],
                pose.rocking.roll_radians + change[4],
                pose.rocking.height_metres + height * math.expm1(change[5]),
            ),
        )

    for number in range(7):
        change = np.zeros(7)
        change[number] = small
        ahead, behind = (
            adjustment.transfer(adjustment.changed(calibration, sign * change), a, b, pixels)
            for sign in (1, -1)
        )
        numeric = (ahead - behind) / (2 * small)
        np.testing.assert_allclose(found.by_camera[:, number].T, numeric, atol=2e-5)
    for number in range(6):
        by_a, by_b = (
            (
                adjustment.transfer(calibration, *ahead, pixels)
                - adjustment.transfer(calibration, *behind, pixels)
            )
            / (2 * small)
            for ahead, behind in (
                ((moved(a, number, small), b), (moved(a, number, -small), b)),
                ((a, moved(b, number, small)), (a, moved(b, number, -small))),
            )
        )
        np.testing.assert_allclose(found.by_a[:, number].T, by_a, atol=2e-5)
        np.testing.assert_allclose(found.by_b[:, number].T, by_b, atol=2e-5)


def test_a_wrong_camera_is_recovered_with_honest_sigmas(true_camera: Calibration) -> None:
    poses = drive(turning=True)
    matches = observe(true_camera, poses, {}, 0.1)
    found = adjusted(adjustment.changed(true_camera, WRONG), poses, matches, rocking=False)
    error = errors(found.calibration, true_camera)
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    assert np.all(np.abs(error)[FREE] < 4.0 * sigmas[FREE])
    assert np.all(sigmas[FREE] < [0.001, 0.001, math.radians(0.03), math.radians(0.03)])
    np.testing.assert_allclose(found.camera_change, error - WRONG, atol=1e-9)
    for index, pose in poses.items():
        apart = pose.inverse() @ found.poses[index].map_from_robot
        assert apart.translation_length < 0.001
        assert abs(apart.theta) < 0.001


def test_a_straight_drive_does_not_determine_the_focal_length(true_camera: Calibration) -> None:
    poses = drive(turning=False)
    matches = observe(true_camera, poses, {}, 0.1)
    found = adjusted(true_camera, poses, matches, rocking=False)
    assert math.sqrt(found.camera_covariance[0, 0]) > 0.02


def test_sigmas_stay_honest_when_the_errors_of_a_frame_are_correlated(
    true_camera: Calibration,
) -> None:
    poses = drive(turning=True, count=8)
    plain = observe(true_camera, poses, {}, 0.1)
    ratios = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        bent = {index: generator.normal(0.0, 0.4, (2, 2)) for index in poses}
        matches = []
        for pair in plain:
            # Each image is stretched a little, as blur or a rolling shutter does.
            far = pair.pixels_b / true_camera.image_size - 0.5
            matches.append(replace(pair, pixels_b=pair.pixels_b + far @ bent[pair.b]))
        found = adjusted(true_camera, poses, matches, rocking=False)
        sigmas = np.sqrt(np.diag(found.camera_covariance))
        ratios.append(errors(found.calibration, true_camera)[FREE] / sigmas[FREE])
    assert np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_rocking_is_estimated_and_not_confused_with_motion(true_camera: Calibration) -> None:
    poses = drive(turning=True, count=16)
    generator = np.random.default_rng(7)
    sigma = math.radians(0.3)
    rockings = {
        index: Rocking(*generator.normal(0.0, sigma, 2), generator.normal(0.0, 0.002))
        for index in poses
    }
    matches = observe(true_camera, poses, rockings, 0.1)
    found = adjusted(adjustment.changed(true_camera, WRONG), poses, matches, rocking=True)
    assert found.rocking_sigmas[:2] == pytest.approx([sigma, sigma], rel=0.5)
    assert found.rocking_sigmas[2] * true_camera.height_metres == pytest.approx(0.002, rel=0.5)
    assert abs(errors(found.calibration, true_camera)[0]) < 0.005
    still = adjusted(adjustment.changed(true_camera, WRONG), poses, matches, rocking=False)
    worst = [
        max((poses[i].inverse() @ fit.poses[i].map_from_robot).translation_length for i in poses)
        for fit in (found, still)
    ]
    assert worst[0] < 0.5 * worst[1]


def textured(seed: int = 1) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).standard_normal((240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def test_spots_are_found_to_hundredths_of_a_pixel_and_lines_along_one_direction() -> None:
    bend = np.array([[1.02, 0.03, 3.4], [-0.02, 0.98, -2.7], [2e-5, 1e-5, 1.0]])
    far_off = np.array([[1.0, 0.0, 5.0], [0.0, 1.0, -4.0], [0.0, 0.0, 1.0]])
    near = np.array([[1.0, 0.0, 1.5], [0.0, 1.0, -1.2], [0.0, 0.0, 1.0]]) @ bend
    image = textured()
    mask = np.full(image.shape, 255, np.uint8)
    # Brighter and of more contrast, as another exposure makes it.
    other = cv2.warpPerspective(image, bend, (320, 240), flags=cv2.INTER_CUBIC)
    other = np.clip(0.7 * other.astype(np.float32) + 20, 0, 255).astype(np.uint8)
    seen = cv2.warpPerspective(mask, np.linalg.inv(bend), (320, 240))
    first, second = (adjustment.make_pyramid(picture, mask) for picture in (image, other))
    points = adjustment.choose_points(first, adjustment.pixel_information(first), seen, 120)
    assert len(points) > 80
    for predicted, coarsest, limit in ((far_off, 3, 0.1), (near, 1, 0.05)):
        kept, pixels, _ = adjustment.track(
            first, second, points, partial(apply_homography, predicted), coarsest
        )
        truth = apply_homography(bend, points[kept])
        inside = np.all((truth > 20) & (truth < (300, 220)), axis=1)
        error = np.linalg.norm(pixels - truth, axis=1)[inside]
        assert len(error) > 50
        assert np.median(error) < limit
        # Each is aligned until its own steps are short, whatever others there are.
        few, alone, _ = adjustment.track(
            first, second, points[kept[:9]], partial(apply_homography, predicted), coarsest
        )
        np.testing.assert_array_equal(few, np.arange(9))
        np.testing.assert_allclose(alone, pixels[:9], atol=1e-4)
    stripe = np.full((240, 320), 40, np.uint8)
    stripe[100:120] = 220
    line = adjustment.make_pyramid(cv2.GaussianBlur(stripe, (0, 0), 1.0), mask)
    points = adjustment.choose_points(line, adjustment.pixel_information(line), mask, 100)
    kept, _, whitening = adjustment.track(line, line, points, lambda pixels: pixels)
    assert len(kept) > 5
    assert np.all(np.abs(whitening[:, :, 0]) < 1e-3 * np.abs(whitening[:, :, 1]).max())


def test_the_square_fixes_the_height(true_camera: Calibration, tmp_path: Path) -> None:
    floor = Pose2(0.45, 0.03, 0.2).apply(square_target(0.3)[:, ::-1] * (-1.0, 1.0))
    corners, seen = project_floor(true_camera, floor)
    assert seen.all()
    wrong = rocked(true_camera, Rocking(0.0, 0.0, 0.03))
    save_calibration(tmp_path / "a.yaml", wrong, CalibrationSource("p.png", "square", 0.3, corners))
    origin = load_origin(tmp_path / "a.yaml")
    still = adjustment.FramePose(Pose2(), Rocking())

    def found(camera: Calibration, own: adjustment.FramePose = still) -> adjustment.Adjustment:
        none = np.zeros(7)
        camera_only = (camera, {0: own}, none, np.diag(none), {}, np.full(3, 1e-4), 1.0, 0.0)
        return adjustment.Adjustment(*camera_only)

    assert true_scale(origin, None, found(true_camera)) == pytest.approx(1.0, abs=1e-4)
    assert true_scale(origin, None, found(wrong)) == pytest.approx(0.3 / 0.33, abs=1e-3)
    assert true_scale(None, None, found(wrong)) == 1.0
    # The photo is a frame that stood higher, and tilted, while it was taken.
    up = adjustment.FramePose(Pose2(), Rocking(0.01, -0.02, 0.03))
    taken = rocked(true_camera, up.rocking)
    corners, _ = project_floor(taken, floor)
    moved = replace(origin, corners=corners)
    assert true_scale(moved, 0, found(true_camera, up)) == pytest.approx(1.0, abs=1e-4)
    assert abs(true_scale(moved, None, found(true_camera)) - 1.0) > 0.05


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def simulate(folder: Path, *arguments: object) -> Calibration:
    """Simulate a short drive; write beside it the calibration of a camera known wrongly."""
    small = ("--size", "320x240", "--frames", 12, "--k1", -0.2, "--seed", 3, "--no-light")
    result = run("simulate", folder, *small, *arguments)
    assert result.exit_code == 0, result.output
    true = load_calibration(folder / "camera.yaml")
    wrong = adjustment.changed(true, WRONG)
    save_calibration(folder / "wrong.yaml", wrong)
    return true


@pytest.mark.slow
def test_a_drive_corrects_its_camera_and_its_map(tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    true = simulate(drive, "--length", 1.2)
    output = tmp_path / "out"
    result = run("stitch", drive, "-c", drive / "wrong.yaml", "-o", output, "--self-calibrate")
    assert result.exit_code == 0, result.output
    assert "camera       refined" in result.output
    error = errors(load_calibration(output / "calibration.yaml"), true)
    assert abs(error[0]) < 0.005
    assert abs(error[1]) < 0.02
    assert np.all(np.abs(error[3:5]) < math.radians(0.1))
    accuracy = compare(read_poses(output / "poses.csv"), read_poses(drive / "truth.csv"))
    assert accuracy.placed == 12
    assert accuracy.absolute_metres < 0.002
    section = tomllib.loads((output / "run.toml").read_text())["self_calibration"]
    assert section["verdict"] == "refined"
    assert section["pixels_after"] < 0.2 < section["pixels_before"]


@pytest.mark.slow
@pytest.mark.parametrize("camera_name", ["camera.yaml", "wrong.yaml"])
def test_a_straight_drive_leaves_the_camera_as_it_is(tmp_path: Path, camera_name: str) -> None:
    drive = tmp_path / "drive"
    simulate(drive, "--length", 1.0, "--path", "line")
    refined = run("calibrate", "--refine", drive, "-c", drive / camera_name, "-o", tmp_path)
    assert refined.exit_code == 1, refined.output
    assert "do not determine the focal length" in refined.output
    assert not (tmp_path / "calibration.yaml").exists()


def test_refining_needs_a_calibration_and_does_not_read_a_square(tmp_path: Path) -> None:
    frame = tmp_path / "frames" / "0.png"
    frame.parent.mkdir()
    cv2.imwrite(str(frame), textured())
    without = run("calibrate", "--refine", frame.parent, "-o", tmp_path / "other.yaml")
    assert without.exit_code == 1
    assert "-c" in without.output
    save_calibration(tmp_path / "camera.yaml", make_camera(CameraOptions()))
    assert run("calibrate", frame, "-c", tmp_path / "camera.yaml").exit_code == 2
