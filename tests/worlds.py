"""A simulated world with exact truth: photographs of an asphalt floor at given poses."""

from __future__ import annotations

import math

import numpy as np

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions

CAMERA = CameraOptions(size=(320, 240), height_metres=0.2, pitch_degrees=45.0)


def make_photographer(seed: int = 3, camera: CameraOptions = CAMERA) -> photograph.Photographer:
    """Return a camera over an asphalt floor, another one for each seed."""
    floor = floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=seed)
    return photograph.Photographer(photograph.World(floor), photograph.make_camera(camera))


def take(photographer: photograph.Photographer, pose: Pose2, seed: int = 0) -> np.ndarray:
    """Return the picture from a standing robot; the seed is of the camera's noise."""
    generator = np.random.default_rng(seed)
    return photograph.take(photographer, (pose, pose), 0.0, DisturbanceOptions(), generator)


def error_of(estimate: slamcli.PoseEstimate, truth: Pose2) -> tuple[float, float]:
    """Return how far a placed frame is from the truth, in metres and degrees."""
    assert estimate.map_from_robot is not None, estimate.reason
    error = truth.inverse() @ estimate.map_from_robot
    return error.translation_length, abs(math.degrees(error.theta))
