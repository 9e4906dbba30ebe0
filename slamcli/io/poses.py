"""poses.csv: one row a frame, its pose in the map or why there is none."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slamcli.core.geometry import covariance_in_map
from slamcli.core.records import PoseEstimate
from slamcli.io.files import write_text

# Decimals of metres and of radians: a micrometre, and less than that ten metres away.
_LENGTH_DIGITS, _ANGLE_DIGITS = 6, 7
COLUMNS = (
    "index",
    "frame",
    "stamp",
    "status",
    "reason",
    "fragment",
    "x",
    "y",
    "heading",
    "sigma_x",
    "sigma_y",
    "sigma_heading",
    "inliers",
    "score",
    "rocking_pitch",
    "rocking_roll",
    "rocking_height",
)


def write_poses(path: Path, estimates: Iterable[PoseEstimate]) -> None:
    """Write one row a frame.

    x, y and their sigmas are metres (pixels without a calibration) in the map's axes; heading and
    its sigma radians, counter-clockwise from the map's x; stamp seconds; rocking radians and
    metres. What is not known is an empty field.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_row(estimate) for estimate in estimates)
    write_text(path, stream.getvalue())


def _row(estimate: PoseEstimate) -> list[str]:
    stamp = "" if estimate.stamp is None else f"{estimate.stamp:.6f}"
    head = [str(estimate.index), estimate.name, stamp, estimate.status, estimate.reason]
    pose, covariance = estimate.map_from_robot, estimate.covariance
    if pose is None:
        return [*head, *[""] * (len(COLUMNS) - len(head))]
    place = [str(estimate.fragment), _length(pose.x), _length(pose.y), _angle(pose.theta)]
    if covariance is None:
        sigmas = [""] * 3
    else:
        variances = np.diag(covariance_in_map(pose, covariance))
        sigmas = [f"{math.sqrt(value):.3e}" for value in variances]
    score = "" if math.isnan(estimate.score) else f"{estimate.score:.4f}"
    tilt = [""] * 3
    if estimate.rocking is not None:
        rocking = estimate.rocking
        tilt = [_angle(rocking.pitch_radians), _angle(rocking.roll_radians)]
        tilt.append(_length(rocking.height_metres))
    return [*head, *place, *sigmas, str(estimate.inliers), score, *tilt]


def _length(metres: float) -> str:
    return f"{metres:.{_LENGTH_DIGITS}f}"


def _angle(radians: float) -> str:
    return f"{radians:.{_ANGLE_DIGITS}f}"
