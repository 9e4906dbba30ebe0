"""Loops in light mapped with calibrations from squares: ATE, scale, and whether the sigmas hold.

Run: python benchmarks/calibrated_loops.py [--length METRES] [--frames N] [--squares N]
[--csv FILE]. A drive once around a circle over asphalt, in light, is mapped once with the true
calibration (square -1) and once with each of several calibrations from photos of a square that the
same camera took. NEES is 3 when sigmas, those of the scale among them, are honest. The poses of one
map err together: over five maps a mean of 1.3 to 5.5 is within its 95 % band.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import cv2
import numpy as np
import sweep
from calibration_targets import Photo, render, true_points
from drives import make_drive
from placements import accuracy

from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import apply_homography
from slamcli.core.records import PoseEstimate
from slamcli.mapping.mapper import Mapper
from slamcli.run.calibrate import CalibrateOptions, find_target
from slamcli.simulation.config import CameraOptions, SimulationOptions
from slamcli.stages import calibrate

SEED = 3
SIDES_METRES = (0.1, 0.2, 0.3048)
MARGIN_PIXELS, MIN_AREA_SHARE = 10.0, 0.03


@dataclass(frozen=True)
class Cell:
    """One map: of the drive, with the calibration from one square, or the true one (-1)."""

    length_metres: float
    frames: int
    square: int


def calibrate_from_square(camera: CameraOptions, true: Calibration, index: int) -> Calibration:
    """Return the calibration from one photo of a square, whose place and size are random."""
    generator = np.random.default_rng([SEED, index])
    width, height = true.image_size
    while True:
        ahead = true.height_metres / math.tan(true.pitch_radians) * generator.uniform(0.6, 1.5)
        place = [ahead, ahead * generator.uniform(-0.3, 0.3), generator.uniform(-0.8, 0.8)]
        photo = Photo(
            camera={
                "height_metres": camera.height_metres,
                "pitch_degrees": camera.pitch_degrees,
                "roll_degrees": camera.roll_degrees,
                "field_of_view_degrees": camera.field_of_view_degrees,
                "size": list(camera.size),
            },
            imaging={},
            noise_gray=2.0,
            floor_share=0.25,
            white=True,
            side_metres=float(generator.choice(SIDES_METRES)),
            place=place,
        )
        pixels = apply_homography(true.image_from_robot, true_points("square", photo)[0])
        inside = (pixels > MARGIN_PIXELS) & (pixels < np.array([width, height]) - 1 - MARGIN_PIXELS)
        area = cv2.contourArea(pixels.astype(np.float32)) / (width * height)
        if inside.all() and area > MIN_AREA_SHARE:
            break
    image, _ = render("square", photo, index)
    found = find_target(image, CalibrateOptions(photo.side_metres), None)
    mounting = calibrate.solve_mounting(found.points, true.image_size)
    return calibrate.make_calibration(mounting, true.image_size, None, None)


def measure(cell: Cell) -> sweep.Row:
    """Map the drive with one calibration, and compare it with the truth."""
    camera = CameraOptions()
    drive = make_drive(
        SimulationOptions(
            length_metres=cell.length_metres, frames=cell.frames, camera=camera, seed=SEED
        )
    )
    calibration = drive.calibration
    if cell.square >= 0:
        calibration = calibrate_from_square(camera, calibration, cell.square)
    mapper = Mapper(calibration)
    for index in range(cell.frames):
        mapper.update(drive.frame(index))
    estimates = mapper.finish()
    whole = accuracy(estimates, drive.folder)
    scale, scaled = errors_of_scale(estimates, drive.truth)
    assert whole.consistency is not None
    return {
        "placed": whole.poses,
        "ate_mm": round(1e3 * whole.absolute.rmse, 3),
        "scale_percent": round(100 * scale, 4),
        "scaled_ate_mm": round(1e3 * scaled, 3),
        "nees": round(whole.consistency.nees, 2),
        "within": round(whole.consistency.within_95_percent, 3),
    }


def errors_of_scale(estimates: list[PoseEstimate], truth: list[object]) -> tuple[float, float]:
    """Return by which share the map is too large, and its ATE, metres, without that."""
    placed = [e for e in estimates if e.map_from_robot is not None]
    here = np.array([complex(e.map_from_robot.x, e.map_from_robot.y) for e in placed])  # type: ignore[union-attr]
    there = np.array([complex(truth[e.index].x, truth[e.index].y) for e in placed])  # type: ignore[attr-defined]
    here, there = here - here.mean(), there - there.mean()
    factor = np.vdot(here, there) / np.vdot(here, here)
    left = factor * here - there
    return 1.0 / abs(factor) - 1.0, math.sqrt(float(np.mean(np.abs(left) ** 2)))


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--length", type=float, default=36.0)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--squares", type=int, default=5)
    sweep.add_arguments(parser)
    arguments = parser.parse_args()
    squares = range(-1, arguments.squares)
    cells = [Cell(arguments.length, arguments.frames, square) for square in squares]
    rows = sweep.run(cells, measure, arguments)
    rows = [row for row in rows if float(row["length_metres"]) == arguments.length]
    found = [row for row in rows if int(row["square"]) >= 0]
    if found:
        ates = [float(row["ate_mm"]) for row in found]
        scaled = max(float(row["scaled_ate_mm"]) for row in found)
        nees = np.mean([float(row["nees"]) for row in found])
        print(
            f"{len(found)} squares: ATE {np.median(ates):.2f} mm in the median, at most "
            f"{scaled:.3f} mm after one scale factor; NEES {nees:.2f}"
        )


if __name__ == "__main__":
    main()
