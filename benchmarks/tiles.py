"""Tiles with marks: false links, and frames placed, over pitch x marks x step x seed.

Run: python benchmarks/tiles.py --csv FILE [--shard I/N] [--limit N] [--summary]. Each drive takes
60 frames (640 x 480, camera 0.30 m high, 42 degrees down, true calibration) once around a circle,
over tiles of one print but for marks of 3 to 10 mm that are 10 to 40 % darker or lighter. A link
is false when it is over 2 cm or 1 degree off the truth. Tiles without marks are mapped three
times: with `max_step_metres` of half a tile where no step is longer, with odometry, and with
neither.

By the world's geometry alone, a frame counts as showing enough when three marks lie wholly, in it
and in the frame before it, in the picture, and cover at least `MIN_MARK_PIXELS` of each; of tiles
without marks, when the joints in both fix all three degrees of the motion.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import sweep
from drives import Drive, make_drive
from numpy.typing import NDArray
from placements import EDGE_SPACING_METRES, fixes_motion, place

from slamcli.core.camera.projection import project_floor
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.simulation.config import CameraOptions, FloorOptions, SimulationOptions
from slamcli.simulation.floors.laid import tile_marks

PITCHES = (0.10, 0.20, 0.30, 0.45, 0.60)
MARKS = (0, 3, 10, 30)
STEPS = (0.02, 0.05, 0.10, 0.15)
FRAMES = 60
NEEDED_MARKS = 3
MIN_MARK_PIXELS = 6.0
# The camera sees less far than this.
REACH_METRES = 1.6
# Share of a pitch up to which a step has one reading alone.
CLEAR_STEP = 1.0 / 3.0
AIDS = ("max-step", "odometry", "none")


@dataclass(frozen=True)
class Cell:
    """A drive, and what the mapper is given beside its frames."""

    pitch_metres: float
    marks: int
    step_metres: float
    seed: int
    aid: str = "none"


def simulation(cell: Cell) -> SimulationOptions:
    """Return the options of a cell's drive."""
    return SimulationOptions(
        floor="tiles",
        surface=FloorOptions(wear=0.0, tile_metres=cell.pitch_metres, marks=cell.marks),
        path="loop",
        length_metres=FRAMES * cell.step_metres,
        frames=FRAMES,
        camera=CameraOptions(height_metres=0.30, pitch_degrees=42.0),
        seed=cell.seed,
    )


def showing_marks(cell: Cell, drive: Drive) -> list[int]:
    """Return the frames that share enough visible marks with the frame before them."""
    marks = _marks_along(cell, drive.truth)
    seen = [_visible(marks, pose, drive) for pose in drive.truth]
    enough = [len(a & b) >= NEEDED_MARKS for a, b in pairwise(seen)]
    return [index for index, shown in enumerate([enough[0], *enough]) if shown]


def showing_joints(cell: Cell, drive: Drive) -> list[int]:
    """Return the frames that share joints enough to fix their motion, up to whole tiles."""
    low, high = (np.array(ends) for ends in zip(*_tiles_along(cell, drive.truth), strict=True))
    side = cell.pitch_metres
    steps = [np.arange(low[i] * side, (high[i] + 1) * side, EDGE_SPACING_METRES) for i in (0, 1)]
    joints = [np.arange(low[i], high[i] + 1) * side for i in (0, 1)]
    along_y = np.dstack(np.meshgrid(joints[0], steps[1])).reshape(-1, 2)
    along_x = np.dstack(np.meshgrid(steps[0], joints[1])).reshape(-1, 2)
    points = np.vstack([along_y, along_x])
    normals = np.repeat(np.eye(2), [len(along_y), len(along_x)], axis=0)
    fixed = [
        fixes_motion(points, normals, pair, drive.calibration) for pair in pairwise(drive.truth)
    ]
    return [index for index, shown in enumerate([fixed[0], *fixed]) if shown]


def _tiles_along(cell: Cell, truth: list[Pose2]) -> list[tuple[int, int]]:
    """Return the first and the last tile that a drive may see, of columns and of rows."""
    places = np.array([(pose.x, pose.y) for pose in truth])
    low = np.floor((places.min(axis=0) - REACH_METRES) / cell.pitch_metres).astype(int)
    high = np.floor((places.max(axis=0) + REACH_METRES) / cell.pitch_metres).astype(int)
    return [(int(low[0]), int(high[0])), (int(low[1]), int(high[1]))]


def _marks_along(cell: Cell, truth: list[Pose2]) -> NDArray[np.float64]:
    """Return (N, 3): x, y and the mean radius, metres, of the marks on all tiles along a drive."""
    (left, right), (bottom, top) = _tiles_along(cell, truth)
    surface = simulation(cell).surface
    marks = [
        (*mark.centre, math.sqrt(float(mark.radii[0] * mark.radii[1])))
        for column, row in product(range(left, right + 1), range(bottom, top + 1))
        for mark in tile_marks(surface, column, row, cell.seed)
    ]
    return np.array(marks).reshape(-1, 3)


def _visible(marks: NDArray[np.float64], pose: Pose2, drive: Drive) -> set[int]:
    """Return the numbers of the marks that a picture from a pose shows."""
    calibration = drive.calibration
    robot = pose.inverse().apply(marks[:, :2])
    pixels, seen = project_floor(calibration, robot)
    # How many pixels a square metre of floor covers there.
    scale = robot @ calibration.image_from_robot[2, :2] + calibration.image_from_robot[2, 2]
    density = abs(float(np.linalg.det(calibration.image_from_robot))) / np.abs(scale) ** 3
    area = math.pi * marks[:, 2] ** 2 * density
    inset = np.sqrt(area)
    size = np.array(calibration.image_size)
    inside = np.all((pixels > inset[:, None]) & (pixels < size - 1 - inset[:, None]), axis=1)
    return set(np.flatnonzero(seen & inside & (area >= MIN_MARK_PIXELS)).tolist())


def measure(cell: Cell, *, reasons: bool) -> sweep.Row:
    """Map one cell's drive; print its false links and lost frames where that is wanted."""
    drive = make_drive(simulation(cell))
    limit = cell.pitch_metres / 2 if cell.aid == "max-step" else None
    frames = map(drive.frame, range(FRAMES))
    readings = drive.odometry if cell.aid == "odometry" else []
    options = MapperOptions(max_step_metres=limit)
    result = place(frames, drive.truth, drive.calibration, options, readings)
    if reasons:
        print("\n".join(result.describe()))
    showing = set(showing_marks(cell, drive) if cell.marks else showing_joints(cell, drive))
    return {
        "links": len(result.links),
        "false_links": len(result.false_links),
        "false_frames": len(result.false_frames),
        "tracked": len(result.tracked),
        "showing": len(showing),
        "tracked_showing": len(result.tracked & showing),
        "fragments": result.fragments,
        "seconds": round(result.seconds, 2),
    }


def summarise(rows: list[dict[str, str]]) -> None:
    """Print false links and placed frames of marked tiles, and of plain ones by aid."""
    marked = [row for row in rows if row["marks"] != "0"]
    groups = [("with marks", marked)]
    for aid in AIDS:
        plain = [row for row in rows if row["marks"] == "0" and row["aid"] == aid]
        clear = [
            row
            for row in plain
            if float(row["step_metres"]) < CLEAR_STEP * float(row["pitch_metres"])
        ]
        groups += [(f"no marks, {aid}", plain), (f"no marks, {aid}, steps below 1/3", clear)]
    for name, chosen in groups:
        if chosen:
            false = sweep.total(chosen, "false_links")
            placed = sweep.share(
                sweep.total(chosen, "tracked_showing"), sweep.total(chosen, "showing")
            )
            print(
                f"{name}: {len(chosen)} drives, false {false} of {sweep.total(chosen, 'links')} "
                f"links, {sweep.total(chosen, 'false_frames')} frames; placed {placed}; "
                f"{sum(row['false_links'] != '0' for row in chosen)} drives with a false link"
            )


def main() -> None:
    """Run the cells that the file does not have yet, and print what all of them say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sweep.add_arguments(parser)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    cells = [
        Cell(pitch, marks, step, seed, aid)
        for seed, pitch, marks, step in product(range(arguments.seeds), PITCHES, MARKS, STEPS)
        for aid in (AIDS if marks == 0 else ("none",))
        if aid != "max-step" or step <= pitch / 2
    ]
    summarise(sweep.run(cells, lambda cell: measure(cell, reasons=arguments.reasons), arguments))


if __name__ == "__main__":
    main()
