"""A recording for the viewer of rerun.io: floor, path, loops and pictures along the time.

rerun is imported here and nowhere else, and only when such a recording is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.errors import InputError, OutputError
from slamcli.core.records import FloorMap, PoseEstimate
from slamcli.io.files import write_bytes

_PATH, _LOOP, _ROBOT = (31, 111, 235), (240, 140, 0), (215, 48, 39)
# Sizes of lines and of the robot, as shares of the path's extent.
_LINE_SHARE, _ROBOT_SHARE, _MIN_EXTENT = 0.001, 0.03, 1e-3
_QUADRANGLE = np.array([[0, 1, 2], [0, 2, 3]])
_TEXTURE_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class FloorTexture:
    """A mosaic to be shown on the floor.

    Attributes
    ----------
    name : str
    image : (H, W, 3) uint8 BGR
    corners : (4, 2) float64
        Upper left, upper right, lower right, lower left outer corner, metres of the map.
    """

    name: str
    image: UInt8Array
    corners: Float64Array


def check_rerun() -> None:
    """Refuse an export when rerun is not installed; raises InputError."""
    if find_spec("rerun") is None:
        raise InputError("--rerun needs rerun-sdk: pip install 'slamcli[rerun]'")


def write_rerun(
    path: Path,
    floor_map: FloorMap,
    floors: Sequence[FloorTexture],
    picture_of: Callable[[PoseEstimate], bytes | None],
) -> None:
    """Write a recording.

    Parameters
    ----------
    picture_of : function
        Of a frame: its picture as JPEG; None for none.

    Raises
    ------
    OutputError
    """
    import rerun

    recording = rerun.RecordingStream("slamcli", recording_id=str(path.stem))
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    # rerun's own writer of files waits for ever where the disk is full.
    stream = recording.memory_recording()
    try:
        _log_map(rerun, recording, floor_map, floors)
        for estimate in floor_map.estimates:
            _log_frame(rerun, recording, estimate, picture_of(estimate))
        data = stream.drain_as_bytes()
    except RuntimeError as error:
        raise OutputError(f"cannot write {path}: {error}") from error
    write_bytes(path, data)


def _log_map(
    rerun: Any, recording: Any, floor_map: FloorMap, floors: Sequence[FloorTexture]
) -> None:
    """Log what is there all the time: the floor, the whole path of each fragment, the loops."""
    recording.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for floor in floors:
        mesh = rerun.Mesh3D(
            vertex_positions=_on_floor(floor.corners, 0.0),
            triangle_indices=_QUADRANGLE,
            vertex_texcoords=_TEXTURE_CORNERS,
            albedo_texture=cv2.cvtColor(floor.image, cv2.COLOR_BGR2RGB),
        )
        recording.log(f"map/{floor.name}", mesh, static=True)
    poses = {
        estimate.index: estimate.map_from_robot
        for estimate in floor_map.estimates
        if estimate.map_from_robot is not None
    }
    radius = _LINE_SHARE * _extent(poses.values())
    for fragment in sorted({one.fragment for one in floor_map.estimates if one.index in poses}):
        members = [one.index for one in floor_map.estimates if one.fragment == fragment]
        points = np.array([(poses[i].x, poses[i].y) for i in members if i in poses])
        strips = rerun.LineStrips3D([_on_floor(points, 4 * radius)], radii=radius, colors=_PATH)
        recording.log(f"map/path_{fragment}", strips, static=True)
    loops = [
        _on_floor(np.array([(poses[i].x, poses[i].y) for i in (link.a, link.b)]), 8 * radius)
        for link in floor_map.links
        if link.kind == "loop" and {link.a, link.b} <= poses.keys()
    ]
    if loops:
        strips = rerun.LineStrips3D(loops, radii=0.5 * radius, colors=_LOOP)
        recording.log("map/loops", strips, static=True)
    size = _ROBOT_SHARE * _extent(poses.values())
    arrow = rerun.Arrows3D(vectors=[[size, 0.0, 0.0]], radii=0.1 * size, colors=_ROBOT)
    recording.log("map/robot", arrow, static=True)


def _log_frame(rerun: Any, recording: Any, estimate: PoseEstimate, picture: bytes | None) -> None:
    """Log one frame at its moment: its number, and its stamp where there is one."""
    recording.set_time("frame", sequence=estimate.index)
    if estimate.stamp is not None:
        recording.set_time("stamp", duration=estimate.stamp)
    if picture is not None:
        image = rerun.EncodedImage(contents=picture, media_type="image/jpeg")
        recording.log("camera", image)
    pose = estimate.map_from_robot
    if pose is None:
        text = rerun.TextLog(f"{estimate.name}: {estimate.reason}", level="WARN")
        recording.log("lost", text)
        return
    half = 0.5 * pose.theta
    turn = rerun.Quaternion(xyzw=[0.0, 0.0, np.sin(half), np.cos(half)])
    where = rerun.Transform3D(translation=[pose.x, pose.y, 0.0], quaternion=turn)
    recording.log("map/robot", where)
    if np.isfinite(estimate.score):
        recording.log("score", rerun.Scalars(estimate.score))


def _extent(poses: Any) -> float:
    points = np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2)
    sides = np.ptp(points, axis=0) if len(points) else np.zeros(2)
    return max(float(np.hypot(*sides)), _MIN_EXTENT)


def _on_floor(points: Float64Array, height: float) -> Float64Array:
    """Return (N, 3) points at a height above the floor."""
    return np.column_stack([points, np.full(len(points), height)])
