"""Keyframes of a map whose poses were estimated in another way than by tracking.

A self-calibration changes the camera, and so what every view shows; a survey estimates a tilt and a
height for each frame. Their keyframes are made from the frames once the map is finished.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import relative_poses
from slamcli.core.records import FloorMap, Frame, Keyframe, PoseEstimate
from slamcli.mapping.keyframes import encode_keyframe
from slamcli.mapping.preprocessing import Preprocessor
from slamcli.stages import covisibility
from slamcli.stages.view import registration_metres_per_pixel

# A frame of which a keyframe sees this share of the floor is none itself
# [guarded by tests/run/stitch/test_keyframes.py].
_MIN_SEEN = 0.5


class KeyframeViews:
    """Makes the keyframes of a finished map.

    Parameters
    ----------
    floor_map : FloorMap
        Its own keyframes are not used.
    """

    def __init__(self, floor_map: FloorMap) -> None:
        calibration = floor_map.calibration
        self.metres_per_pixel = registration_metres_per_pixel(calibration)
        options = replace(
            MapperOptions(),
            features=floor_map.features,
            metres_per_pixel=self.metres_per_pixel,
            tilt_sigma_degrees=floor_map.tilt_sigma_degrees,
        )
        self._preprocessor = Preprocessor(calibration, options)
        self._rocking = {one.index: one.rocking or Rocking() for one in floor_map.estimates}

    def make(self, frame: Frame) -> Keyframe | None:
        """Return the keyframe of a frame, by its own tilt and height; None if it is of no use."""
        prepared = self._preprocessor.prepare(frame, self._rocking[frame.index])
        if prepared.reason or prepared.features is None:
            return None
        return encode_keyframe(prepared)


def chosen_keyframes(calibration: Calibration, estimates: Sequence[PoseEstimate]) -> list[int]:
    """Return the frames, by index, that see floor of which no chosen one sees enough."""
    footprint = covisibility.Footprint(calibration)
    chosen: dict[int, list[tuple[float, float, float]]] = {}
    found = []
    for estimate in estimates:
        if estimate.map_from_robot is None:
            continue
        pose = estimate.map_from_robot.x, estimate.map_from_robot.y, estimate.map_from_robot.theta
        others = chosen.setdefault(estimate.fragment, [])
        if not others or footprint.overlaps(relative_poses(others, pose)).max() < _MIN_SEEN:
            others.append(pose)
            found.append(estimate.index)
    return found
