"""A plain line in view: noise along it is no proof of a motion along it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Grid, Pose2, squared_mahalanobis
from slamcli.core.records import Frame, PreparedFrame
from slamcli.mapping.mapper import Mapper
from slamcli.registration import acceptance, register
from slamcli.registration.hypothesis import PyramidPair, score_refined
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions
from slamcli.stages import dense

CAMERA = CameraOptions(size=(400, 300), height_metres=0.2, pitch_degrees=45.0)


def photographer_of(white: int, black: int) -> photograph.Photographer:
    def paint_a_line(grid: Grid) -> UInt8Array:
        y = grid.y_max - grid.metres_per_pixel * np.arange(grid.height)
        row = np.where(np.abs(y - 0.03) < 0.012, np.uint8(white), np.uint8(black))
        return np.broadcast_to(row[:, None, None], (grid.height, grid.width, 3)).copy()

    floor = floors.BlockFloor(paint_a_line, 0.001)
    return photograph.Photographer(photograph.World(floor), photograph.make_camera(CAMERA))


def pose_at(step: int) -> Pose2:
    return Pose2(0.03 * step, 0.01 * math.sin(0.3 * step), 0.05 * math.sin(0.3 * step + 1.0))


def two_frames(white: int, black: int, seed: int) -> tuple[Mapper, list[PreparedFrame]]:
    photographer = photographer_of(white, black)
    mapper = Mapper(photographer.calibration)
    frames = []
    for index in range(2):
        pose = pose_at(seed % 5 + index)
        generator = np.random.default_rng(1000 * index + seed)
        image = photograph.take(photographer, (pose, pose), 0.0, DisturbanceOptions(), generator)
        frames.append(mapper.prepare(Frame(index, str(index), None, image)))
    return mapper, frames


@pytest.mark.parametrize(("white", "black", "seed"), [(220, 60, 13), (220, 60, 19), (235, 12, 4)])
def test_a_motion_along_a_plain_line_is_open(white: int, black: int, seed: int) -> None:
    """With this noise, of 40 tried, the line seems to fix the motion to 3 mm."""
    mapper, frames = two_frames(white, black, seed)
    pair = PyramidPair(frames[0].levels, frames[1].levels)
    motion = pose_at(seed % 5).inverse() @ pose_at(seed % 5 + 1)
    refined = dense.refine(pair.a[:2], pair.b[:2], motion, mapper.calibration, 0.0)
    assert refined is not None
    fit = score_refined(pair, refined)
    range_metres = mapper.calibration.max_range_metres
    assert acceptance.check_observable(fit, range_metres, MapperOptions()).startswith(
        "the motion is open along"
    )
    # Across the line it is fixed all the same, and so is the turn.
    across = math.sqrt(float(np.linalg.eigvalsh(fit.covariance[:2, :2])[0]))
    assert across < 0.001
    assert abs(math.degrees((motion.inverse() @ refined.a_from_b).theta)) < 0.02


def test_an_open_motion_is_measured_where_it_is_expected() -> None:
    """The pixels alone put it 4 cm away, and only the residuals show that it is open."""
    mapper, frames = two_frames(235, 12, 1)
    motion = pose_at(1).inverse() @ pose_at(2)
    prior = dense.MotionPrior(motion, np.diag([0.005, 0.005, 0.02]) ** 2)
    window = dense.SearchWindow(motion, 0.3, 0.05)
    found = register(*frames, None, mapper.calibration, MapperOptions(), window=window, prior=prior)
    assert found.link is None
    assert found.partial is not None
    measured, covariance = found.partial.a_from_b, found.partial.covariance
    assert (measured.inverse() @ motion).translation_length < 0.005
    assert squared_mahalanobis(measured, covariance, motion) < 11.3
