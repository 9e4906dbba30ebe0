"""Scenes: the connected parts of a map, each with its frames in the axes that it is painted in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.mounting import rocked
from slamcli.core.config import Datum, ProductOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, PosedFrame, PoseEstimate
from slamcli.io.frames import FrameFile
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.stages.geodesy import project_map


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One fragment's frames, in the axes that it is painted in: the map's, turned.

    Attributes
    ----------
    calibration : Calibration
        Common to the frames.
    files : tuple of FrameFile
        Of the tracked frames. What a predicted one shows was of no use to place it.
    shots : tuple of PosedFrame
        Poses of the same frames, ``painted_from_robot``.
    estimates : tuple of PoseEstimate
        Of all placed frames, ``painted_from_robot``.
    map_from_painted : Pose2
    datum : Datum or None
        Where the map's origin lies on Earth, as far as measured.
    thumbnails : Thumbnails
        Of the frames decoded before.
    keep_picture : function or None
        Called with each frame that is decoded, at half its size, where that does for the map.
    """

    calibration: Calibration
    files: tuple[FrameFile, ...]
    shots: tuple[PosedFrame, ...]
    estimates: tuple[PoseEstimate, ...]
    map_from_painted: Pose2
    datum: Datum | None
    thumbnails: Thumbnails
    keep_picture: Callable[[Frame], None] | None = None


def scenes_of(
    calibration: Calibration,
    estimates: Sequence[PoseEstimate],
    file_of: Callable[[PoseEstimate], FrameFile],
    options: ProductOptions,
    datums: Mapping[int, Datum] | None = None,
    thumbnails: Thumbnails | None = None,
) -> list[Scene]:
    """Return one scene for every fragment, in the fragments' order.

    Parameters
    ----------
    options : ProductOptions
        A map on Earth that is written as GeoTIFF is painted with north up, unless they turn it; a
        planner's map keeps its axes, as few planners read a turned one.
    datums : mapping of int to Datum or None
        Of the fragments whose place on Earth was measured.
    """
    scenes = []
    for fragment, members in placed_fragments(estimates).items():
        datum = options.datum or (datums or {}).get(fragment)
        painted_from_map = Pose2(0.0, 0.0, _turn(options, datum))
        turned = tuple(_turned(one, painted_from_map) for one in members)
        tracked = [one for one in turned if one.status == "tracked"]
        shots = tuple(
            PosedFrame(
                one.index,
                one.map_from_robot,
                calibration if one.rocking is None else rocked(calibration, one.rocking),
            )
            for one in tracked
            if one.map_from_robot is not None
        )
        scenes.append(
            Scene(
                calibration,
                tuple(file_of(one) for one in tracked),
                shots,
                turned,
                painted_from_map.inverse(),
                datum,
                thumbnails or Thumbnails(),
            )
        )
    return scenes


def _turn(options: ProductOptions, datum: Datum | None) -> float:
    """Return the angle from the map's axes to those that it is painted in."""
    on_earth = datum is not None and "geotiff" in options.all_formats
    if options.turn_radians != 0.0 or not on_earth or "nav2" in options.formats:
        return options.turn_radians
    assert datum is not None
    return project_map(datum, options.crs).turn_radians


def _turned(estimate: PoseEstimate, painted_from_map: Pose2) -> PoseEstimate:
    if estimate.map_from_robot is None or painted_from_map.theta == 0.0:
        return estimate
    return replace(estimate, map_from_robot=painted_from_map @ estimate.map_from_robot)
