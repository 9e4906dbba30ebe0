"""features.csv: one row for each keypoint that a detector found."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

from slamcli.core.camera.calibration import Unit
from slamcli.core.records import Features, Keypoints
from slamcli.io.files import write_text

COLUMNS = ("frame", "x", "y", "size", "angle", "response", "octave")
FLOOR_COLUMNS = ("x_metres", "y_metres")


def write_keypoints(
    path: Path, found: Iterable[tuple[str, Keypoints, Features]], unit: Unit
) -> None:
    """Write one row a point.

    x and y are the column and the row, in pixels of the picture that was searched: with a
    calibration the bird's-eye view, and then also the point on the floor in metres, in the robot's
    frame; size is a diameter in its pixels, angle is in degrees, clockwise, nan where the
    descriptor does not turn; octave is the pyramid level.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    metric = unit == "m"
    writer.writerow((*COLUMNS, *FLOOR_COLUMNS) if metric else COLUMNS)
    for name, keypoints, features in found:
        for index, (x, y) in enumerate(keypoints.pixels):
            row = [
                name,
                f"{x:.3f}",
                f"{y:.3f}",
                f"{keypoints.sizes[index]:.2f}",
                f"{keypoints.angles[index]:.2f}",
                f"{keypoints.responses[index]:.6g}",
                str(keypoints.octaves[index]),
            ]
            if metric:
                row += [f"{value:.6f}" for value in features.points[index]]
            writer.writerow(row)
    write_text(path, stream.getvalue())
