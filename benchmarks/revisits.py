"""Floor that is driven over again and again: false links, frames placed, error, keyframes.

Run: python benchmarks/revisits.py --csv FILE [--shard I/N] [--limit N] [--summary]. Each drive
takes 120 frames of 640 x 480, true calibration, over one kind of floor: three *laps* of a circle,
each of another phase and a little to the side; *to and fro* along a line, always looking ahead;
the same, *turned* around at either end; *lanes* side by side. Some are disturbed, or have odometry.
A link is false when it is over 2 cm or 1 degree off the truth.

Printed: the error from frame to frame and of the map as a whole, and the number of keyframes, which
is to grow with the floor and not with the time.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import sweep
from drives import make_drive
from placements import accuracy, place

from slamcli.core.geometry import Pose2
from slamcli.simulation import floors
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    FloorOptions,
    ImagingOptions,
    SimulationOptions,
)

FRAMES = 120
STEP_METRES = 0.04
ASIDE_METRES = 0.03
CONDITIONS = {
    "none": (DisturbanceOptions(), ImagingOptions()),
    "odometry": (DisturbanceOptions(), ImagingOptions()),
    "changed": (DisturbanceOptions(boxes=4, walkers=10), ImagingOptions()),
    "lamp": (
        DisturbanceOptions(flicker=0.3, motion_blur=0.2),
        ImagingOptions(lamp_share=0.3, auto_exposure=True),
    ),
    "rocking": (DisturbanceOptions(rocking_degrees=0.2), ImagingOptions()),
}


@dataclass(frozen=True)
class Cell:
    """A way over a floor, under some condition."""

    way: str
    floor: str
    condition: str
    seed: int


def laps(generator: np.random.Generator) -> list[Pose2]:
    """Return three laps of a circle."""
    count, phases = FRAMES // 3, generator.uniform(0.0, 1.0, 3).tolist()
    radius = count * STEP_METRES / math.tau
    poses = []
    for lap, step in product(range(3), range(count)):
        angle = math.tau * (step + phases[lap]) / count
        own = radius + ASIDE_METRES * lap / 2
        poses.append(Pose2(own * math.sin(angle), radius - own * math.cos(angle), angle))
    return poses


def to_and_fro(generator: np.random.Generator) -> list[Pose2]:
    """Return four passes of a line, the robot backing up in every second one."""
    count = FRAMES // 4
    poses = []
    for run, step in product(range(4), range(count)):
        along = step if run % 2 == 0 else count - 1 - step
        aside = ASIDE_METRES * math.sin(0.2 * step + run)
        poses.append(Pose2(STEP_METRES * along, aside, float(generator.normal(0.0, 0.01))))
    return poses


def turned(generator: np.random.Generator) -> list[Pose2]:
    """Return passes of a line, the robot turning about at either end."""
    straight, turns = 24, 12
    poses, x, theta = [], 0.0, 0.0
    while len(poses) < FRAMES:
        for _ in range(straight):
            x += STEP_METRES * math.cos(theta)
            poses.append(Pose2(x, float(generator.normal(0.0, 0.004)), theta))
        for _ in range(turns):
            theta += math.pi / turns
            poses.append(Pose2(x, 0.0, theta))
    return poses[:FRAMES]


def lanes(generator: np.random.Generator) -> list[Pose2]:
    """Return lanes side by side, driven on in turn forwards and backwards."""
    count = FRAMES // 5
    poses = []
    for lane, step in product(range(5), range(count)):
        along = step if lane % 2 == 0 else count - 1 - step
        wander = float(generator.normal(0.0, 0.003))
        poses.append(Pose2(STEP_METRES * along, 0.08 * lane + wander, 0.02 * math.sin(along)))
    return poses


WAYS: dict[str, Callable[[np.random.Generator], list[Pose2]]] = {
    "laps": laps,
    "to and fro": to_and_fro,
    "turned": turned,
    "lanes": lanes,
}


def measure(cell: Cell, *, reasons: bool) -> sweep.Row:
    """Map one cell's drive; print its false links and lost frames where that is wanted."""
    disturbances, imaging = CONDITIONS[cell.condition]
    options = SimulationOptions(
        floor=cell.floor,
        surface=FloorOptions(wear=0.4, tile_metres=0.2, marks=5),
        camera=CameraOptions(height_metres=0.28, pitch_degrees=42.0),
        disturbances=disturbances,
        imaging=imaging,
        frames=FRAMES,
        seed=cell.seed,
    )
    generator = np.random.default_rng([cell.seed, list(WAYS).index(cell.way)])
    drive = make_drive(options, WAYS[cell.way](generator))
    readings = drive.odometry if cell.condition == "odometry" else []
    result = place(map(drive.frame, range(FRAMES)), drive.truth, drive.calibration, None, readings)
    if reasons:
        print("\n".join(result.describe()))
    found = accuracy(result.estimates, drive.folder)
    return {
        "links": len(result.links),
        "false_links": len(result.false_links),
        "false_frames": len(result.false_frames),
        "tracked": len(result.tracked),
        "fragments": result.fragments,
        "keyframes": result.keyframes,
        "step_error_millimetres": round(1e3 * found.relative.rmse, 4),
        "map_error_millimetres": round(1e3 * found.absolute.rmse, 4),
        "seconds": round(result.seconds, 2),
    }


def summarise(rows: list[dict[str, str]]) -> None:
    """Print what the drives of each way and of each condition say."""
    for column in ("way", "condition"):
        for name in dict.fromkeys(row[column] for row in rows):
            chosen = [row for row in rows if row[column] == name]
            count = len(chosen)
            false, links = (sweep.total(chosen, each) for each in ("false_links", "links"))
            medians = [
                float(np.median([float(row[each]) for row in chosen]))
                for each in ("step_error_millimetres", "map_error_millimetres", "keyframes")
            ]
            print(
                f"{name}: {count} drives, false {false} of {links} links, "
                f"{sweep.total(chosen, 'false_frames')} frames; "
                f"placed {sweep.share(sweep.total(chosen, 'tracked'), count * FRAMES)}; median "
                f"error of a step {medians[0]:.3f} mm, of the map {medians[1]:.3f} mm; "
                f"{medians[2]:.0f} keyframes"
            )


def main() -> None:
    """Run the cells that the file does not have yet, and print what all of them say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sweep.add_arguments(parser)
    arguments = parser.parse_args()
    kinds = list(enumerate(floors.FLOORS))
    conditions = list(CONDITIONS)
    cells = [
        Cell(way, floor, conditions[(number + place + turn) % len(conditions)], turn)
        for turn in range(2)
        for (place, way), (number, floor) in product(enumerate(WAYS), kinds)
    ]
    summarise(sweep.run(cells, lambda cell: measure(cell, reasons=arguments.reasons), arguments))


if __name__ == "__main__":
    main()
