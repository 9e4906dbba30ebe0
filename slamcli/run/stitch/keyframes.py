"""The keyframes of a map that is written: those of tracking, or made anew for its final camera."""

from __future__ import annotations

from slamcli.core.records import FloorMap
from slamcli.io.frames import read_frame
from slamcli.mapping.keyframe_views import with_new_views
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import LocatedDrive


def with_keyframes(floor_map: FloorMap, located: LocatedDrive, session: Session) -> FloorMap:
    """Return a map with keyframes of its final camera and poses.

    Those of tracking stay where the camera is still the one that frames were tracked with; of
    learned features none are stored.
    """
    tracked = floor_map.calibration is located.mapper.calibration and located.survey is None
    if tracked or floor_map.features.network is not None:
        return floor_map
    files = located.drive.inputs.files
    here = session.on_this_machine()
    return with_new_views(
        floor_map, lambda index: read_frame(files[index], gray=True), here.ordered
    )
