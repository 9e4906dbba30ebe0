"""`slam locate`: where frames are in a finished map, each by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.geometry import covariance_in_map
from slamcli.core.records import PoseEstimate
from slamcli.io.files import refuse_existing
from slamcli.io.frames import list_frames
from slamcli.io.map_file import load_map
from slamcli.io.poses import write_poses
from slamcli.mapping.localizer import Locator
from slamcli.run.frame_loop import read_and_prepare
from slamcli.run.session.session import Session


@dataclass(frozen=True, slots=True)
class LocateReport:
    """What to tell the user, the same for a program, and the exit code."""

    lines: tuple[str, ...]
    json: str
    exit_code: int


def locate(
    floor_map: Path,
    sources: Sequence[Path],
    output: Path | None,
    *,
    overwrite: bool,
    session: Session,
) -> LocateReport:
    """Find the frames of folders or files in a map; exit 1 when none is there.

    Parameters
    ----------
    output : Path or None
        A CSV as poses.csv.

    Raises
    ------
    InputError, MapError, OutputError
    """
    if output is not None:
        refuse_existing(output, overwrite=overwrite)
    locator = Locator(load_map(floor_map))
    files = list_frames(sources, None)
    work = partial(read_and_prepare, locator.prepare)
    found = [locator.place(prepared) for prepared in session.stage("locating", work, files)]
    if output is not None:
        write_poses(output, found)
    unit = locator.calibration.unit
    return LocateReport(
        tuple(_lines(found, unit)),
        json.dumps([_entry(estimate) for estimate in found], indent=2, ensure_ascii=False),
        0 if any(estimate.map_from_robot is not None for estimate in found) else 1,
    )


def _lines(found: Sequence[PoseEstimate], unit: str) -> list[str]:
    """Return the table: a row a frame, then how many are on the map."""
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
    placed = sum(estimate.map_from_robot is not None for estimate in found)
    return [*lines, f"{placed} of {len(found)} frames are on the map"]


def _entry(estimate: PoseEstimate) -> dict[str, Any]:
    """Return what is known of a frame: metres and radians, in the map's axes."""
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
