"""Honesty of the sigmas of links: NEES of pairs of frames, over floors and disturbances.

Run: python benchmarks/sigmas.py [--seeds N] [--csv FILE] [--shard I/N] [--summary]. A cell is a
short drive in light, mapped with the true calibration; its frames are aligned in pairs by
photometric refinement from near their true motion. NEES is the mean of e^T C^-1 e over the pairs,
e the error of a motion and C its covariance: 3 when sigmas are honest, less when they are too wide.
As the pairs of a drive share its 14 frames, 1.3 to 5.4 is within the 95 % band of one drive.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

import numpy as np
import sweep
from drives import Drive, make_drive
from robustness import COURSE_START

from slamcli.core.geometry import Pose2
from slamcli.mapping.mapper import Mapper
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    ImagingOptions,
    SimulationOptions,
)
from slamcli.stages import dense

FLOORS = ("asphalt", "concrete", "carpet", "tiles", "terrazzo", "course")
CONDITIONS = {
    "none": SimulationOptions(),
    "noise": SimulationOptions(disturbances=DisturbanceOptions(noise_gray=8.0)),
    "no-noise": SimulationOptions(disturbances=DisturbanceOptions(noise_gray=0.5), jpeg_quality=98),
    "blur": SimulationOptions(disturbances=DisturbanceOptions(motion_blur=0.2)),
    "jpeg": SimulationOptions(jpeg_quality=40),
    "sharpened": SimulationOptions(imaging=ImagingOptions(bayer=True, sharpening=0.5)),
}
CAMERAS = (CameraOptions(), CameraOptions(size=(480, 360), height_metres=0.4, pitch_degrees=50.0))
FRAMES, LAGS = 14, (1, 3, 6)
STEP_METRES, RADIUS_METRES, COURSE_RADIUS_METRES = 0.06, 1.5, 0.45
# Of the start, off the true motion: metres and radians.
START_OFF = Pose2(0.001, -0.001, 0.001)


@dataclass(frozen=True)
class Cell:
    """One drive: a floor, a disturbance, and the seed of both, which chooses the camera."""

    floor: str
    condition: str
    seed: int


def drive_of(cell: Cell) -> Drive:
    """Return the frames of a cell, along an arc."""
    options = replace(
        CONDITIONS[cell.condition],
        floor=cell.floor,
        camera=CAMERAS[cell.seed % len(CAMERAS)],
        seed=cell.seed,
    )
    course = cell.floor == "course"
    turn = STEP_METRES / (COURSE_RADIUS_METRES if course else RADIUS_METRES)
    poses = [COURSE_START if course else Pose2()]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ Pose2(STEP_METRES, 0.0, turn))
    return make_drive(options, poses)


def measure(cell: Cell) -> sweep.Row:
    """Align the pairs of one drive, and compare their errors with their sigmas."""
    drive = drive_of(cell)
    mapper = Mapper(drive.calibration)
    levels = [mapper.prepare(drive.frame(index)).levels[:2] for index in range(FRAMES)]
    squares, predicted, errors = [], [], []
    for a, b in [(a, a + lag) for lag in LAGS for a in range(FRAMES - lag)]:
        true = drive.truth[a].inverse() @ drive.truth[b]
        fit = dense.refine(levels[a], levels[b], true @ START_OFF, mapper.calibration, 0.0)
        if fit is not None:
            off = fit.a_from_b.inverse() @ true
            error = np.array([off.x, off.y, off.theta])
            errors.append(error)
            squares.append(error @ np.linalg.solve(fit.covariance, error))
            predicted.append(error @ np.linalg.solve(fit.predicted_covariance, error))
    return {
        "pairs": len(squares),
        "nees": round(float(np.mean(squares)), 2),
        "median": round(float(np.median(squares)), 2),
        "largest": round(float(np.max(squares)), 1),
        "predicted_nees": round(float(np.mean(predicted)), 2),
        "error_mm": round(1e3 * math.sqrt(float(np.mean(np.array(errors)[:, :2] ** 2))), 4),
    }


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    sweep.add_arguments(parser)
    arguments = parser.parse_args()
    cells = [Cell(f, c, s) for s in range(arguments.seeds) for c in CONDITIONS for f in FLOORS]
    rows = sweep.run(cells, measure, arguments)
    print("| floor | " + " | ".join(CONDITIONS) + " |\n" + "|---" * (len(CONDITIONS) + 1) + "|")
    for floor in FLOORS:
        shares = [
            [float(r["nees"]) for r in rows if (r["floor"], r["condition"]) == (floor, condition)]
            for condition in CONDITIONS
        ]
        print(f"| {floor} | " + " | ".join(f"{np.mean(s):.1f}" if s else "" for s in shares) + " |")


if __name__ == "__main__":
    main()
