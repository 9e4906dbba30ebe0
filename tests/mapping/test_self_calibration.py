"""Self-calibration in the library: a finished mapper's camera and map refined by its frames."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import make_photographer, take

import slamcli
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.errors import FrameError
from slamcli.io.map_file import save_map
from slamcli.mapping import self_calibration
from slamcli.selfcal import SelfCalibration


def with_longer_focal_length(true: Calibration, factor: float) -> Calibration:
    matrix = true.camera_matrix @ np.diag([factor, factor, 1.0])
    mounting = true.height_metres, true.pitch_radians, true.roll_radians, true.ahead_radians
    return replace(
        true, camera_matrix=matrix, robot_from_image=compose_robot_from_image(matrix, *mounting)
    )


@pytest.mark.slow
def test_a_wrong_focal_length_is_found_by_the_frames(tmp_path: Path) -> None:
    photographer = make_photographer()
    true = photographer.calibration
    wrong = with_longer_focal_length(true, 1.03)
    poses = [slamcli.Pose2(0.04 * k, 0.004 * k * k, 0.1 * k) for k in range(12)]
    frames = [
        slamcli.Frame(index, f"{index}.png", None, take(photographer, pose, index))
        for index, pose in enumerate(poses)
    ]
    mapper = slamcli.Mapper(wrong)
    for frame in frames:
        mapper.update(frame)
    mapper.finish()
    done = slamcli.self_calibrate(mapper, frames.__getitem__)
    assert done.verdict == "refined", done.reason
    focal = done.registration.calibration.camera_matrix[0, 0]
    assert focal == pytest.approx(true.camera_matrix[0, 0], rel=0.01)
    save_map(tmp_path / "map.slam", done.registration.floor_map)
    locator = slamcli.Locator(slamcli.load_map(tmp_path / "map.slam"))
    found = locator.locate(frames[3])
    there = done.registration.estimates[3].map_from_robot
    assert (there.inverse() @ found.map_from_robot).translation_length < 0.003
    assert mapper.calibration is wrong
    assert math.isfinite(done.pixels_after)


def test_a_frame_that_cannot_be_read_again_is_lost_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    photographer = make_photographer()
    mapper = slamcli.Mapper(photographer.calibration)
    frames = [
        slamcli.Frame(k, f"{k}.png", None, take(photographer, slamcli.Pose2(0.04 * k), k))
        for k in range(3)
    ]
    for frame in frames:
        mapper.update(frame)
    mapper.finish()

    def read(index: int) -> slamcli.Frame:
        if index == 1:
            raise FrameError("cannot be read: the disk is gone")
        return frames[index]

    registered = []

    def refine(first: object, read: object, register: Any, *others: object) -> SelfCalibration:
        registered.append(register(photographer.calibration))
        return SelfCalibration(registered[0], "not applied", "")

    monkeypatch.setattr(self_calibration, "refine_calibration", refine)
    slamcli.self_calibrate(mapper, read)
    statuses = [(one.name, one.status, one.reason) for one in registered[0].estimates]
    assert statuses[1] == ("1.png", "lost", "cannot be read: the disk is gone")
    assert [status for _, status, _ in statuses] == ["tracked", "lost", "tracked"]
