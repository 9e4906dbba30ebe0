"""Line courses: false links, and frames placed, over layouts x cameras, of flat paint.

Run: python benchmarks/courses.py --csv FILE [--all] [--shard I/N] [--limit N] [--summary]. Ten
layouts, drawn by chance from a number, each with one of five cameras (with --all: with each), 60
frames of 640 x 480 at a step of 7 cm; once with odometry and once without. A link is false when it
is over 2 cm or 1 degree off the truth.

By the world's geometry alone, a frame counts as fixed when the edges of paint in both it and the
frame before it fix all three degrees of the motion, else as open. A break is a fixed frame that
lies in another fragment than the frame before it, both placed.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import sweep
from drives import Drive, make_drive
from numpy.typing import NDArray
from placements import EDGE_SPACING_METRES, fixes_motion, place

from slamcli.core.geometry import Pose2
from slamcli.run.simulate import COURSE_START
from slamcli.simulation.config import (
    CameraOptions,
    CourseLayout,
    FloorOptions,
    SimulationOptions,
)

FRAMES = 60
STEP_METRES = 0.07
LAYOUTS = 10
BOARD_METRES = (3.0, 2.4)
LINE_METRES, SQUARE_METRES = 0.025, 0.15
ROOM_METRES = 7.0
# The last two see the horizon.
CAMERAS = (
    CameraOptions(height_metres=0.40, pitch_degrees=45.0),
    CameraOptions(height_metres=0.30, pitch_degrees=42.0),
    CameraOptions(height_metres=0.26, pitch_degrees=32.0),
    CameraOptions(height_metres=0.24, pitch_degrees=17.0),
    CameraOptions(height_metres=0.11, pitch_degrees=12.0),
)
COUNTED = (
    "links",
    "false_links",
    "false_frames",
    "fixed",
    "tracked_fixed",
    "open",
    "tracked_open",
    "predicted_open",
    "breaks",
)
HORIZON = (False, False, False, True, True)


@dataclass(frozen=True)
class Cell:
    """A layout, a camera, and whether the mapper has odometry."""

    layout: int
    camera: int
    odometry: bool


def make_layout(number: int) -> CourseLayout:
    """Return a layout: lines along both axes with stubs, and squares, on a grid of 15 cm."""
    generator = np.random.default_rng([number, 2015])
    length, width = BOARD_METRES
    columns, rows = round(length / SQUARE_METRES), round(width / SQUARE_METRES)
    lines = []
    for _ in range(int(generator.integers(7, 15))):
        x, y = int(generator.integers(1, columns)), int(generator.integers(1, rows))
        reach = int(generator.integers(2, 9))
        if generator.uniform() < 0.5:
            ends = (x, y), (min(x + reach, columns - 1), y)
        else:
            ends = (x, y), (x, min(y + reach, rows - 1))
        lines.append(tuple(_on_board(*end) for end in ends))
    squares = []
    for _ in range(int(generator.integers(2, 7))):
        x, y = int(generator.integers(1, columns - 1)), int(generator.integers(1, rows - 1))
        squares.append(_on_board(x, y))
    return CourseLayout(
        board_metres=BOARD_METRES,
        line_metres=LINE_METRES,
        square_metres=SQUARE_METRES,
        lines=tuple(lines),  # type: ignore[arg-type]
        squares=tuple(squares),
    )


def _on_board(column: int, row: int) -> tuple[float, float]:
    return column * SQUARE_METRES, row * SQUARE_METRES - BOARD_METRES[1] / 2


def simulation(cell: Cell) -> SimulationOptions:
    """Return the options of a cell's drive: a circle around the board's middle."""
    return SimulationOptions(
        floor="course",
        surface=FloorOptions(wear=0.0, layout=make_layout(cell.layout)),
        room_metres=ROOM_METRES if HORIZON[cell.camera] else 0.0,
        path="loop",
        length_metres=FRAMES * STEP_METRES,
        frames=FRAMES,
        camera=CAMERAS[cell.camera],
        seed=cell.layout,
    )


def edges_of(layout: CourseLayout) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (N, 2) on the paint's outline, in the board's frame, and their normals."""
    half = layout.line_metres / 2
    boxes = [
        (np.minimum(start, end) - half, np.maximum(start, end) + half)
        for start, end in layout.lines
    ]
    boxes += [(np.array(low), np.array(low) + layout.square_metres) for low in layout.squares]
    points, normals = [], []
    for low, high in boxes:
        for axis, side in product((0, 1), (low, high)):
            other = 1 - axis
            along = np.arange(
                low[other] + EDGE_SPACING_METRES / 2, high[other], EDGE_SPACING_METRES
            )
            edge = np.empty((len(along), 2))
            edge[:, axis], edge[:, other] = side[axis], along
            points.append(edge)
            normals.append(np.tile(np.eye(2)[axis], (len(along), 1)))
    found, across = np.vstack(points), np.vstack(normals)
    beside = [_painted(found + sign * 0.001 * across, boxes) for sign in (-1.0, 1.0)]
    rim = beside[0] != beside[1]
    return found[rim] - (layout.board_metres[0] / 2, 0.0), across[rim]


def _painted(
    points: NDArray[np.float64], boxes: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), bool)
    for low, high in boxes:
        inside |= np.all((points > low) & (points < high), axis=1)
    return inside


def fixed_frames(drive: Drive, layout: CourseLayout) -> set[int]:
    """Return the frames whose motion from the frame before the paint in both fixes."""
    points, normals = edges_of(layout)
    poses: list[Pose2] = [COURSE_START @ pose for pose in drive.truth]
    fixed = [fixes_motion(points, normals, pair, drive.calibration) for pair in pairwise(poses)]
    return {index for index, shown in enumerate([fixed[0], *fixed]) if shown}


def measure(cell: Cell, *, reasons: bool) -> sweep.Row:
    """Map one cell's drive; print its false links and lost frames where that is wanted."""
    options = simulation(cell)
    drive = make_drive(options)
    readings = drive.odometry if cell.odometry else []
    frames = map(drive.frame, range(FRAMES))
    result = place(frames, drive.truth, drive.calibration, odometry=readings)
    if reasons:
        print("\n".join(result.describe()))
    fixed = fixed_frames(drive, options.surface.layout)
    predicted = {e.index for e in result.estimates if e.status == "predicted"}
    fragments = [result.fragment_of(index) for index in range(FRAMES)]
    breaks = [
        index
        for index in fixed
        if index and -1 not in fragments[index - 1 : index + 1]
        if fragments[index] != fragments[index - 1]
    ]
    return {
        "links": len(result.links),
        "false_links": len(result.false_links),
        "false_frames": len(result.false_frames),
        "fixed": len(fixed),
        "tracked_fixed": len(result.tracked & fixed),
        "open": FRAMES - len(fixed),
        "tracked_open": len(result.tracked - fixed),
        "predicted_open": len(predicted - fixed),
        "fragments": result.fragments,
        "breaks": len(breaks),
        "seconds": round(result.seconds, 2),
    }


def summarise(rows: list[dict[str, str]]) -> None:
    """Print what is false and what is placed, with odometry and without."""
    for odometry in ("False", "True"):
        chosen = [row for row in rows if row["odometry"] == odometry]
        if not chosen:
            continue
        count = {name: sweep.total(chosen, name) for name in COUNTED}
        print(
            f"odometry {odometry}: {len(chosen)} drives, false {count['false_links']} of "
            f"{count['links']} links, {count['false_frames']} frames; fixed frames placed "
            f"{sweep.share(count['tracked_fixed'], count['fixed'])}, {count['breaks']} breaks; of "
            f"{count['open']} open ones {count['tracked_open']} tracked, "
            f"{count['predicted_open']} predicted"
        )


def main() -> None:
    """Run the cells that the file does not have yet, and print what all of them say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sweep.add_arguments(parser)
    parser.add_argument("--all", action="store_true", help="every layout with every camera")
    arguments = parser.parse_args()
    cells = [
        Cell(layout, camera, odometry)
        for layout, camera, odometry in product(range(LAYOUTS), range(len(CAMERAS)), (False, True))
        if arguments.all or camera == layout % len(CAMERAS)
    ]
    summarise(sweep.run(cells, lambda cell: measure(cell, reasons=arguments.reasons), arguments))


if __name__ == "__main__":
    main()
