"""Drives whose frames' matches are known exactly: no image is made, pixels are projected."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.geometry import Pose2
from slamcli.selfcal.bundle import MAX_SIGMAS, BundleRound
from slamcli.simulation.config import CameraOptions
from slamcli.simulation.photograph import make_camera
from slamcli.stages import adjustment

TRUE = make_camera(CameraOptions(size=(320, 240)))
# Of log focal length, two radial coefficients, pitch, roll and principal point.
CHANGE = np.array([0.02, 0.0, 0.0, math.radians(0.5), 0.0, 0.0, 0.0])
WRONG = adjustment.changed(TRUE, -CHANGE)


def drive(turning: bool, count: int = 12) -> dict[int, Pose2]:
    """Return the poses of frames 0.1 m apart, on a line or turning by 20 degrees each."""
    step = Pose2(0.1, 0.0, math.radians(20.0) if turning else 0.0)
    poses = {0: Pose2()}
    for index in range(1, count):
        poses[index] = poses[index - 1] @ step
    return poses


def observe(
    calibration: Calibration,
    poses: dict[int, Pose2],
    rockings: dict[int, Rocking],
    noise_pixels: float,
) -> list[adjustment.Matches]:
    """Return the matches of frames at most two apart, every tenth an outlier."""
    generator = np.random.default_rng(5)
    width, height = calibration.image_size
    frame_poses = {
        i: adjustment.FramePose(pose, rockings.get(i, Rocking())) for i, pose in poses.items()
    }
    matches = []
    for a, b in [(a, a + apart) for a in poses for apart in (1, 2) if a + apart in poses]:
        pixels_a = generator.uniform([0, height * 0.2], [width, height], (150, 2))
        pixels_b = adjustment.transfer(calibration, frame_poses[a], frame_poses[b], pixels_a)
        seen = np.isfinite(pixels_b).all(axis=1)
        seen &= np.all((pixels_b > 0) & (pixels_b < calibration.image_size), axis=1)
        pixels_a, pixels_b = pixels_a[seen], pixels_b[seen]
        pixels_b = pixels_b + generator.normal(0.0, noise_pixels, pixels_b.shape)
        pixels_b[::10] += generator.uniform(-15.0, 15.0, pixels_b[::10].shape)
        whitening = np.tile(np.eye(2) / noise_pixels, (len(pixels_a), 1, 1))
        matches.append(adjustment.Matches(a, b, pixels_a, pixels_b, whitening))
    return matches


POSES = drive(turning=True, count=6)


def bundle_round(
    change: NDArray[np.float64] = CHANGE, sigmas: NDArray[np.float64] = 0.2 * MAX_SIGMAS
) -> BundleRound:
    """Return a round of self-calibration that found the true camera, after some change of it."""
    found = adjustment.Adjustment(
        TRUE,
        {index: adjustment.FramePose(pose, Rocking()) for index, pose in POSES.items()},
        change,
        np.diag(sigmas**2),
        {index: np.zeros((3, 3)) for index in POSES},
        np.zeros(3),
        1.0,
        0.0,
    )
    return BundleRound(observe(TRUE, POSES, {}, 0.1), found)
