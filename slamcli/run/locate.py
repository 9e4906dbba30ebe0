"""`slam locate`: the pose of each frame, by itself, in a finished map."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.config import FrameSelection
from slamcli.core.exit_codes import ExitCode, of_placement
from slamcli.core.geometry import covariance_in_map
from slamcli.core.records import PoseEstimate
from slamcli.io.frames import list_frames, of_camera
from slamcli.io.map_file import load_map, map_path
from slamcli.io.outputs import refuse_existing
from slamcli.io.poses import write_poses
from slamcli.mapping.localizer import Follower, Locator
from slamcli.run.frame_loop import read_and_prepare
from slamcli.run.session.session import Session


@dataclass(frozen=True, slots=True)
class LocateReport:
    """The lines to print, the same as JSON, and the exit code."""

    lines: tuple[str, ...]
    json: str
    exit_code: ExitCode


def locate(
    floor_map: Path,
    sources: Sequence[Path],
    output: Path | None,
    *,
    overwrite: bool,
    strict: bool = False,
    selection: FrameSelection | None = None,
    follow: bool = False,
    session: Session,
) -> LocateReport:
    """Find the frames of folders or files in a map.

    Parameters
    ----------
    output : Path or None
        A CSV as poses.csv.
    strict : bool
        Exit 3 when any frame is lost.
    selection : FrameSelection or None
        Of the frames of a video.
    follow : bool
        The frames are of one drive: each is looked for first near where the one before was.

    Raises
    ------
    InputError, MapError, OutputError
    """
    listed = list_frames(sources, None, selection, session.progress)
    if output is not None:
        inputs = (map_path(floor_map), *(file.path for file in listed))
        refuse_existing(output, inputs=inputs, overwrite=overwrite)
    locator = Locator(load_map(floor_map))
    files = of_camera(listed, locator.calibration.image_size)
    work = partial(read_and_prepare, locator.prepare)
    place = Follower(locator).place if follow else locator.place
    found = [place(prepared) for prepared in session.stage("locating", work, files)]
    if output is not None:
        write_poses(output, found)
    unit = locator.calibration.unit
    placed = sum(estimate.map_from_robot is not None for estimate in found)
    code = of_placement(placed, len(found), strict=strict)
    lines = _lines(found, unit)
    lines.append(f"{placed} of {len(found)} frames are on the map")
    if code == ExitCode.INCOMPLETE:
        lines[-1] = f"incomplete: {lines[-1]}"
    return LocateReport(
        tuple(lines),
        json.dumps([_entry(estimate) for estimate in found], indent=2, ensure_ascii=False),
        code,
    )


def _lines(found: Sequence[PoseEstimate], unit: str) -> list[str]:
    """Return the table: a row a frame."""
    name_width = max(len("frame"), *(len(estimate.name) for estimate in found))
    lines = [
        f"{'frame':<{name_width}}  {'map':>3}  {'x ' + unit:>10}  {'y ' + unit:>10}  "
        f"{'heading °':>9}  {'sigma ' + unit:>9}  {'sigma °':>8}  {'score':>6}"
    ]
    for estimate in found:
        pose, covariance = estimate.map_from_robot, estimate.covariance
        if pose is None or covariance is None:
            lines.append(f"{estimate.name:<{name_width}}  {estimate.reason}")
            continue
        sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        turn = math.degrees(math.sqrt(float(covariance[2, 2])))
        lines.append(
            f"{estimate.name:<{name_width}}  {estimate.fragment:>3}  {pose.x:>10.4f}  "
            f"{pose.y:>10.4f}  {math.degrees(pose.theta):>9.2f}  {sigma:>9.2g}  {turn:>8.2g}  "
            f"{estimate.score:>6.3f}"
        )
    return lines


def _entry(estimate: PoseEstimate) -> dict[str, Any]:
    """Return a frame's pose as JSON: metres and radians, in the map's axes; or why it has none."""
    entry: dict[str, Any] = {"frame": estimate.name}
    pose, covariance = estimate.map_from_robot, estimate.covariance
    if pose is None or covariance is None:
        return {**entry, "here": False, "reason": estimate.reason}
    return {
        **entry,
        "here": True,
        "fragment": estimate.fragment,
        "x": pose.x,
        "y": pose.y,
        "heading": pose.theta,
        "covariance": covariance_in_map(pose, covariance).tolist(),
        "inliers": estimate.inliers,
        "score": estimate.score,
    }
