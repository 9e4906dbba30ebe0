"""Robots that are carried off, lifted, or blinded: frames placed while away, and how soon after.

Run: python benchmarks/kidnap.py --csv FILE [--shard I/N] [--limit N] [--summary]. Twenty drives of
640 x 480, true calibration, one lap and a half around a circle of 30 steps. On the second lap, for
12 frames, the robot is *kidnapped* (lifted, and set down 9 to 14 steps farther on, turned by up to
30 degrees), *lifted* (and set down where it was), its lens is *covered*, or a *hand* hides most of
the view while it drives on.

No frame may be placed while away. It is back when a frame after that is tracked in the fragment of
the first lap, false by no more than 2 cm and 1 degree; `late` is how many frames that takes beyond
the first.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
import sweep
from drives import Drive, make_drive
from numpy.typing import NDArray
from placements import Placements, is_false
from placements import place as map_frames

from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.simulation.config import CameraOptions, FloorOptions, SimulationOptions

EVENTS = ("kidnapped", "lifted", "covered", "hand")
FLOORS = ("asphalt", "tiles", "carpet", "concrete", "parquet")
CAMERA = CameraOptions(height_metres=0.30, pitch_degrees=42.0)
# In the hands the camera is never twice this high and turned in this way: height, pitch, roll.
CARRIED = tuple(
    replace(CAMERA, height_metres=height, pitch_degrees=pitch, roll_degrees=roll)
    for height, pitch, roll in (
        (0.40, 40.0, 3.0),
        (0.52, 37.0, 6.0),
        (0.65, 50.0, -9.0),
        (0.76, 45.0, -4.0),
        (0.85, 30.0, 14.0),
        (0.91, 34.0, 8.0),
    )
)
# Which of them, from frame to frame.
ORDER = (0, 1, 2, 3, 4, 5, 3, 5, 2, 4, 1, 0)
LAP, BEFORE, AWAY, AFTER = 30, 6, len(ORDER), 8
STEP_METRES = 0.07
MAX_TURN_DEGREES = 30.0
CLOCK_HERTZ = 10.0
MAX_LATE = 3
HAND_BGR = (118.0, 142.0, 188.0)


@dataclass(frozen=True)
class Cell:
    """What happens, and over which floor."""

    event: str
    floor: str
    seed: int


def way(cell: Cell) -> list[Pose2]:
    """Return where the robot is at each frame: a lap, a piece of the next, away, and a piece."""
    generator = np.random.default_rng([cell.seed, EVENTS.index(cell.event)])
    before = [_on_circle(step) for step in range(LAP + BEFORE)]
    last = LAP + BEFORE - 1
    if cell.event == "kidnapped":
        back, turn = last + int(generator.integers(9, 15)), math.radians(MAX_TURN_DEGREES)
        turned = Pose2(0.0, 0.0, float(generator.uniform(-turn, turn)))
        away = [_between(last, back, (i + 1) / (AWAY + 1)) for i in range(AWAY)]
    elif cell.event == "lifted":
        back, turned = last, Pose2()
        away = [_on_circle(last)] * AWAY
    else:
        back, turned = last + AWAY + 1, Pose2()
        away = [_on_circle(last + 1 + i) for i in range(AWAY)]
    return before + away + [_on_circle(back + i) @ turned for i in range(AFTER)]


def _on_circle(step: float) -> Pose2:
    angle, radius = math.tau * step / LAP, LAP * STEP_METRES / math.tau
    return Pose2(radius * math.sin(angle), radius * (1.0 - math.cos(angle)), angle)


def _between(start: int, end: int, part: float) -> Pose2:
    """Return the place a part of the way along the chord, turned along."""
    a, b = _on_circle(start), _on_circle(end)
    return Pose2(a.x + part * (b.x - a.x), a.y + part * (b.y - a.y), a.theta + part)


def take_frames(cell: Cell, poses: list[Pose2]) -> tuple[Drive, Iterator[Frame]]:
    """Return the drive without its event, and its frames with it."""
    options = SimulationOptions(
        floor=cell.floor,
        surface=FloorOptions(wear=0.5, tile_metres=0.20, marks=10),
        camera=CAMERA,
        frames=len(poses),
        seed=cell.seed,
    )
    carried: dict[int, NDArray[np.uint8]] = {}
    if cell.event in ("kidnapped", "lifted"):
        for number, camera in enumerate(CARRIED):
            taken = [place for place, chosen in enumerate(ORDER) if chosen == number]
            # A drive's world begins at its first pose: all of them begin at the same.
            lifted = [poses[0], *(poses[LAP + BEFORE + place] for place in taken)]
            few = make_drive(replace(options, frames=len(lifted), camera=camera), lifted)
            carried |= {place: few.image(index) for index, place in enumerate(taken, start=1)}
    drive = make_drive(options, poses)

    def frames() -> Iterator[Frame]:
        for index in range(len(poses)):
            number = index - LAP - BEFORE
            image = drive.image(index)
            if 0 <= number < AWAY:
                image = _changed(cell, number, image, carried)
            yield Frame(index, f"{index:04d}", index / CLOCK_HERTZ, image)

    return drive, frames()


def _changed(
    cell: Cell, number: int, image: NDArray[np.uint8], carried: dict[int, NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """Return the picture that is taken instead, `number` frames after the event began."""
    if carried:
        return carried[number]
    generator = np.random.default_rng([cell.seed, number])
    if cell.event == "covered":
        # A finger on the lens lets a little red light through, most of it on one side.
        across = np.linspace(0.3, 1.0, image.shape[1])[None, :, None]
        light = across * np.array([4.0, 6.0, 26.0]) + generator.normal(0.0, 2.0, image.shape)
        return np.clip(np.round(light), 0, 255).astype(np.uint8)
    return _behind_a_hand(image, number, generator)


def _behind_a_hand(
    image: NDArray[np.uint8], number: int, generator: np.random.Generator
) -> NDArray[np.uint8]:
    """Return a picture of which a hand with four fingers, out of focus, leaves a tenth free."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    shift = 0.05 * width * math.sin(0.9 * number)
    for finger in range(4):
        centre = (round(width * (0.14 + 0.24 * finger) + shift), round(0.35 * height))
        axes = (round(0.115 * width), round(0.42 * height))
        cv2.ellipse(mask, centre, axes, 0.0, 0.0, 360.0, 255, -1)
    cv2.rectangle(mask, (0, round(0.45 * height)), (width, height), 255, -1)
    soft = cv2.GaussianBlur(mask.astype(np.float32) / 255.0, (0, 0), 6.0)[..., None]
    grain = cv2.GaussianBlur(generator.normal(0.0, 60.0, (height, width)), (0, 0), 5.0)
    shade = 0.85 + 0.15 * np.cos(np.linspace(0.0, 9.0, width) + 0.3 * number)
    skin = shade[None, :, None] * np.array(HAND_BGR) + grain[..., None]
    return np.clip(np.round(image + soft * (skin - image)), 0, 255).astype(np.uint8)


def measure(cell: Cell, *, reasons: bool) -> sweep.Row:
    """Map one cell's drive; print its false links and lost frames where that is wanted."""
    poses = way(cell)
    drive, frames = take_frames(cell, poses)
    result = map_frames(frames, drive.truth, drive.calibration)
    if reasons:
        print("\n".join(result.describe()))
    away = range(LAP + BEFORE, LAP + BEFORE + AWAY)
    placed = [index for index in away if result.fragment_of(index) >= 0]
    late = _frames_until_back(result, drive.truth)
    return {
        "links": len(result.links),
        "false_links": len([link for link, _ in result.false_links if link.b not in away]),
        "placed_away": len(placed),
        "tracked_lap": len(result.tracked & set(range(LAP + BEFORE))),
        "late": late,
        "fragments": result.fragments,
        "seconds": round(result.seconds, 2),
    }


def _frames_until_back(result: Placements, truth: list[Pose2]) -> int:
    """Return how many frames after the event are not placed rightly in the first lap's map."""
    lap = result.fragment_of(0)
    origin = result.estimates[0].map_from_robot
    start = LAP + BEFORE + AWAY
    for index in range(start, start + AFTER):
        pose = result.estimates[index].map_from_robot
        if result.fragment_of(index) != lap or pose is None or origin is None:
            continue
        moved, true = origin.inverse() @ pose, truth[0].inverse() @ truth[index]
        if index in result.tracked and not is_false(true.inverse() @ moved):
            return index - start
    return AFTER


def summarise(rows: list[dict[str, str]]) -> None:
    """Print the frames placed while away, and the drives whose robot is back too late."""
    for event in EVENTS:
        chosen = [row for row in rows if row["event"] == event]
        if chosen:
            late = [int(row["late"]) for row in chosen]
            away, false = (sweep.total(chosen, name) for name in ("placed_away", "false_links"))
            links, missed = sweep.total(chosen, "links"), sum(count >= MAX_LATE for count in late)
            print(
                f"{event}: {len(chosen)} drives, {away} frames of {AWAY * len(chosen)} placed "
                f"while away, false {false} of {links} links; back after at most {max(late)}, "
                f"{missed} drives later than {MAX_LATE}"
            )


def main() -> None:
    """Run the cells that the file does not have yet, and print what all of them say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sweep.add_arguments(parser)
    arguments = parser.parse_args()
    cells = [
        Cell(event, floor, seed) for event, (seed, floor) in product(EVENTS, enumerate(FLOORS))
    ]
    summarise(sweep.run(cells, lambda cell: measure(cell, reasons=arguments.reasons), arguments))


if __name__ == "__main__":
    main()
