"""What the robot's other senses say, and the truth when it is known: one CSV each.

Lengths in metres, angles in radians counter-clockwise, stamps in seconds, WGS84 in degrees.
"""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

from slamcli.io.files import write_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from slamcli.core.geometry import Pose2


def write_truth(
    path: Path, names: Sequence[str], stamps: Sequence[float], poses: Sequence[Pose2]
) -> None:
    """Write index, frame, stamp, x, y, heading: ``map_from_robot`` of every frame."""
    rows = (
        (str(index), name, f"{stamp:.6f}", *_pose(pose))
        for index, (name, stamp, pose) in enumerate(zip(names, stamps, poses, strict=True))
    )
    _write(path, ("index", "frame", "stamp", "x", "y", "heading"), rows)


def write_odometry(path: Path, stamps: Sequence[float], poses: Sequence[Pose2]) -> None:
    """Write stamp, x, y, heading: the pose integrated from the start, drift included."""
    rows = ((f"{stamp:.6f}", *_pose(pose)) for stamp, pose in zip(stamps, poses, strict=True))
    _write(path, ("stamp", "x", "y", "heading"), rows)


def write_compass(
    path: Path, stamps: Sequence[float], headings_radians: NDArray[np.float64], sigma: float
) -> None:
    """Write stamp, heading and sigma (rad)."""
    rows = (
        (f"{stamp:.6f}", f"{heading:.6f}", f"{sigma:.6f}")
        for stamp, heading in zip(stamps, headings_radians, strict=True)
    )
    _write(path, ("stamp", "heading", "sigma"), rows)


def write_gps(
    path: Path, stamps: Sequence[float], places_degrees: NDArray[np.float64], sigma: float
) -> None:
    """Write stamp, latitude, longitude (degrees, WGS84) and sigma (m)."""
    rows = (
        (f"{stamp:.6f}", f"{latitude:.10f}", f"{longitude:.10f}", f"{sigma:.3f}")
        for stamp, (latitude, longitude) in zip(stamps, places_degrees, strict=True)
    )
    _write(path, ("stamp", "latitude", "longitude", "sigma"), rows)


def _pose(pose: Pose2) -> tuple[str, str, str]:
    return f"{pose.x:.7f}", f"{pose.y:.7f}", f"{pose.theta:.8f}"


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, stream.getvalue())
