"""Keyframes of a map whose poses were estimated in another way than by tracking.

A self-calibration changes the camera, and so what every view shows; a survey estimates a tilt and a
height for each frame. Their keyframes are made from the frames once the map is finished.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.geometry import relative_poses
from slamcli.core.records import FloorMap, Frame, Keyframe, PoseEstimate
from slamcli.mapping.keyframes import encode_keyframe
from slamcli.mapping.preprocessing import Preprocessor
from slamcli.stages import covisibility
from slamcli.stages.view import registration_metres_per_pixel

# A frame of which a keyframe sees this share of the floor is none itself
# [guarded by tests/run/stitch/test_keyframes.py].
_MIN_SEEN = 0.5
Making = Callable[[int], Keyframe | None]
InOrder = Callable[[Making, Sequence[int]], Iterable[Keyframe | None]]


def with_new_views(
    floor_map: FloorMap, read: Callable[[int], Frame], in_order: InOrder = map
) -> FloorMap:
    """Return a map whose keyframes show what its camera and its poses say.

    Where it has none they are chosen so that they show all of its floor; those that cannot be read
    are left out.

    Parameters
    ----------
    floor_map : FloorMap
    read : callable
        Returns a frame by its index; may raise FrameError.
    in_order : callable
        Like `map`; may work ahead.
    """
    calibration = floor_map.calibration
    metres_per_pixel = registration_metres_per_pixel(calibration)
    options = replace(
        MapperOptions(),
        features=floor_map.features,
        metres_per_pixel=metres_per_pixel,
        tilt_sigma_degrees=floor_map.tilt_sigma_degrees,
    )
    preprocessor = Preprocessor(calibration, options)
    rocking = {one.index: one.rocking or Rocking() for one in floor_map.estimates}

    def make(index: int) -> Keyframe | None:
        try:
            prepared = preprocessor.prepare(read(index), rocking[index])
        except FrameError:
            return None
        usable = not prepared.reason and prepared.features is not None
        return encode_keyframe(prepared) if usable else None

    own = [keyframe.index for keyframe in floor_map.keyframes]
    made = in_order(make, own or _chosen_keyframes(calibration, floor_map.estimates))
    keyframes = tuple(keyframe for keyframe in made if keyframe is not None)
    return replace(floor_map, keyframes=keyframes, metres_per_pixel=metres_per_pixel)


def _chosen_keyframes(calibration: Calibration, estimates: Sequence[PoseEstimate]) -> list[int]:
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
