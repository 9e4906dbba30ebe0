"""The keyframes of a map that is written: those of tracking, or made anew for its final camera."""

from __future__ import annotations

from dataclasses import replace

from slamcli.core.errors import FrameError
from slamcli.core.records import FloorMap, Keyframe
from slamcli.io.frames import FrameFile, read_frame
from slamcli.mapping.keyframe_views import KeyframeViews, chosen_keyframes
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import LocatedDrive


def with_keyframes(floor_map: FloorMap, located: LocatedDrive, session: Session) -> FloorMap:
    """Return a map with keyframes of its final camera and poses.

    Those of tracking stay where the camera is still the one that frames were tracked with.
    """
    if floor_map.calibration is located.mapper.calibration and located.survey is None:
        return floor_map
    if floor_map.features.network is not None:
        return floor_map
    views = KeyframeViews(floor_map)
    indices = [keyframe.index for keyframe in floor_map.keyframes]
    indices = indices or chosen_keyframes(floor_map.calibration, floor_map.estimates)
    files = [located.drive.inputs.files[index] for index in indices]

    def make(file: FrameFile) -> Keyframe | None:
        try:
            return views.make(read_frame(file, gray=True))
        except FrameError:
            return None

    here = session.on_this_machine()
    made = [keyframe for keyframe in here.ordered(make, files) if keyframe is not None]
    return replace(floor_map, keyframes=tuple(made), metres_per_pixel=views.metres_per_pixel)
