"""Fidelity of each blend to the true floor, with the true poses of a simulated drive.

Run: python benchmarks/blends.py DRIVE [--floor NAME] [--metres-per-pixel M] [--obstacles DRIVE
[--only-obstacles]]. DRIVE is what `slam simulate` has written. Compared with the blends are the
plain mean of images as they are, and `cv2.detail.MultiBandBlender`. --obstacles is the same drive
with --walkers or --boxes: frames of it that show any replace those of the first, until 15 % of the
views do.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from peers import COURSE_START, likeness

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.config import PaintOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Frame, PosedFrame
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import list_frames, read_frame
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import FloorOptions
from slamcli.stages.mosaic import exposure, tiles
from slamcli.stages.mosaic.blend import BLENDS
from slamcli.stages.mosaic.exposure import Exposure
from slamcli.stages.mosaic.painter import Painter

OBSTACLES_SHARE = 0.15
# A frame shows an obstacle when this share of it differs by more than noise does.
_DIFFERENT_GRAY, _MIN_SHARE = 12, 0.002
# Floor seen from afar has so little texture that it would hide what blends differ by.
_MIN_RESOLUTION_SHARE = 0.12
_ENOUGH_VIEWS = 2


@dataclass(frozen=True)
class Drive:
    """A simulated drive in memory."""

    calibration: Calibration
    posed_frames: list[PosedFrame]
    frames: list[Frame]


def load(folder: Path) -> Drive:
    """Read a drive."""
    calibration = load_calibration(folder / "camera.yaml")
    rows = list(csv.DictReader((folder / "truth.csv").open()))
    poses = [Pose2(float(row["x"]), float(row["y"]), float(row["heading"])) for row in rows]
    posed_frames = [PosedFrame(number, pose, calibration) for number, pose in enumerate(poses)]
    return Drive(calibration, posed_frames, [read_frame(file) for file in list_frames([folder])])


def estimated_exposure(drive: Drive, frames: list[Frame]) -> Exposure:
    """Return the frames' gains and the lens's vignetting."""
    hull = footprint_hull(drive.calibration)
    step = exposure.comparison_step(drive.calibration)
    observed = []
    for frame, posed in zip(frames, drive.posed_frames, strict=True):
        small = exposure.thumbnail(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY))
        pose = posed.map_from_robot
        observed.append(exposure.observe(small, drive.calibration, hull, pose, step))
    return exposure.estimate_exposure(observed)


def paint(
    drive: Drive,
    frames: list[Frame],
    options: PaintOptions,
    light: Exposure | None,
) -> tuple[Grid, NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
    """Return a map's grid, its image, and the resolution and the number of views of each pixel."""
    scale = options.metres_per_pixel
    assert scale is not None
    painter = Painter(drive.calibration, scale, options, light)
    pictures = [painter.picture(frame, number) for number, frame in enumerate(frames)]
    painted = {}
    for key, numbers in painter.plan(drive.posed_frames):
        tile = painter.paint(key, drive.posed_frames, numbers, pictures.__getitem__)
        if tile is not None:
            painted[key] = tile
    grid = tiles.extent_of(painted, scale)
    assert grid is not None
    image = np.zeros((grid.height, grid.width, 3), np.uint8)
    resolution = np.zeros((grid.height, grid.width), np.float32)
    views = np.zeros(resolution.shape, np.uint16)
    for tile in painted.values():
        top = round((grid.y_max - tile.grid.y_max) / scale)
        left = round((tile.grid.x_min - grid.x_min) / scale)
        part = slice(top, top + tile.grid.height), slice(left, left + tile.grid.width)
        image[part], views[part] = tile.image, tile.views
        resolution[part] = tile.pixels_per_metre
    return grid, image, resolution, views


def opencv(drive: Drive, frames: list[Frame], grid: Grid) -> NDArray[np.uint8]:
    """Return the map as OpenCV's multi-band blender makes it."""
    painter = Painter(drive.calibration, grid.metres_per_pixel)
    blender = cv2.detail_MultiBandBlender()
    blender.setNumBands(5)
    blender.prepare((0, 0, grid.width, grid.height))
    for frame, posed in zip(frames, drive.posed_frames, strict=True):
        part, seen = (
            painter.extent([posed.map_from_robot]),
            painter.patch(frame, posed.map_from_robot),
        )
        left = round((part.x_min - grid.x_min) / grid.metres_per_pixel)
        top = round((grid.y_max - part.y_max) / grid.metres_per_pixel)
        mask = np.where(seen.weight > 0, np.uint8(255), np.uint8(0))
        blender.feed(seen.image.astype(np.int16), mask, (left, top))
    blended, _ = blender.blend(None, None)
    return np.clip(np.asarray(blended), 0, 255).astype(np.uint8)


def true_floor(drive: Drive, name: str, grid: Grid) -> NDArray[np.uint8]:
    """Return the floor under a map."""
    start = COURSE_START if name == "course" else Pose2()
    resolution = photograph.texture_metres_per_pixel(drive.calibration)
    times = round(grid.metres_per_pixel / resolution)
    fine = Grid(
        grid.x_min + start.x,
        grid.y_max + start.y,
        resolution,
        times * grid.width,
        times * grid.height,
    )
    floor = floors.make_floor(name, FloorOptions(wear=0.5), resolution, 0).region(fine)
    size = (grid.width, grid.height)
    return np.asarray(cv2.resize(floor, size, interpolation=cv2.INTER_AREA), np.uint8)


def mixed(clean: list[Frame], obstructed: list[Frame]) -> list[Frame]:
    """Return frames of which a share shows obstacles."""
    around = np.ones((3, 3), np.uint8)
    showing = []
    for number, (plain, other) in enumerate(zip(clean, obstructed, strict=True)):
        differs = cv2.absdiff(plain.image, other.image).max(axis=2) > _DIFFERENT_GRAY
        solid = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, around)
        if solid.mean() > _MIN_SHARE:
            showing.append(number)
    count = round(OBSTACLES_SHARE * len(clean))
    chosen = {showing[place * len(showing) // count] for place in range(min(count, len(showing)))}
    print(f"{len(chosen)} of {len(clean)} frames show obstacles")
    return [obstructed[n] if n in chosen else clean[n] for n in range(len(clean))]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--floor", default="asphalt")
    parser.add_argument("--obstacles", type=Path)
    parser.add_argument("--only-obstacles", action="store_true")
    parser.add_argument("--metres-per-pixel", type=float, default=0.001)
    arguments = parser.parse_args()
    drive, scale = load(arguments.drive), arguments.metres_per_pixel
    frames = drive.frames
    plain = PaintOptions(metres_per_pixel=scale, blend="mean", obstacles=False)
    grid, image, resolution, views = paint(drive, frames, plain, None)
    inside = resolution > _MIN_RESOLUTION_SHARE * resolution.max()
    true = cv2.cvtColor(true_floor(drive, arguments.floor, grid), cv2.COLOR_BGR2GRAY).astype(
        np.float32
    )
    print("| blend | PSNR dB | SSIM | sharpness |\n|---|---|---|---|")

    def row(name: str, picture: NDArray[np.uint8], inside: NDArray[np.bool_] = inside) -> None:
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float32)
        psnr, alike, sharp = likeness(gray, true, inside)
        print(f"| {name} | {psnr:.1f} | {alike:.3f} | {sharp:.2f} |", flush=True)

    light = estimated_exposure(drive, frames)
    for blend in () if arguments.only_obstacles else BLENDS:
        options = PaintOptions(metres_per_pixel=scale, blend=blend)  # type: ignore[arg-type]
        row(blend, paint(drive, frames, options, light)[1])
    if not arguments.only_obstacles:
        row("plain mean, exposure as it is", image)
        row("cv2.detail.MultiBandBlender", opencv(drive, frames, grid))
    if arguments.obstacles is not None:
        some = mixed(frames, load(arguments.obstacles).frames)
        others = estimated_exposure(drive, some)
        # At the rim, where one view alone sees, obstacles cannot be recognised.
        well = inside & (views >= _ENOUGH_VIEWS)
        print(f"{well.sum() / inside.sum():.0%} of the map is seen by {_ENOUGH_VIEWS} or more")
        best = PaintOptions(metres_per_pixel=scale)
        row("best, no obstacles, where two views see", paint(drive, frames, best, light)[1], well)
        for obstacles in (True, False):
            options = PaintOptions(metres_per_pixel=scale, obstacles=obstacles)
            handling = "left out" if obstacles else "painted"
            picture = paint(drive, some, options, others)[1]
            row(f"best, obstacles {handling}", picture)
            row(f"best, obstacles {handling}, where two views see", picture, well)


if __name__ == "__main__":
    main()
