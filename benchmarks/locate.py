"""Localisation of single frames in a map: found, falsely placed, and the cost as maps grow.

Run: python benchmarks/locate.py [--floors a,b] [--frames N] [--keyframes 100,1000,10000]. A camera
of 320x240 drives three lanes over a simulated floor; frames that the map has not seen, at any
heading, are then looked up, and frames of floor outside it. For the cost the first map is filled up
with keyframes whose descriptors are those of its own points with three bits in ten turned over, so
that they crowd the index as real ones do. Processor time on one thread.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slamcli.core.geometry import Pose2
from slamcli.core.records import FloorMap, Frame, Keyframe, PoseEstimate
from slamcli.mapping.localizer import Locator
from slamcli.mapping.mapper import Mapper
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions

CAMERA = CameraOptions(size=(320, 240), height_metres=0.2, pitch_degrees=45.0)
FLOOR_METRES_PER_PIXEL = 0.0005
LANES, LANE_METRES, LANE_LENGTH_METRES, STEP_METRES = 3, 0.2, 1.2, 0.06
# So far ahead lies the middle of the view; about it the camera turns from lane to lane.
MIDDLE_METRES = 0.2
TURN_STEPS = 6
NEAR_METRES, NEAR_RADIANS = 0.01, math.radians(0.5)
OUTSIDE_METRES = (20.0, 60.0)
FLIPPED_SHARE = 0.3
COST_FRAMES = 60


def lanes() -> list[Pose2]:
    """Return poses up and down three lanes."""
    poses: list[Pose2] = []
    for lane in range(LANES):
        side = -1.0 if lane % 2 else 1.0
        start = LANE_LENGTH_METRES if lane % 2 else 0.0
        heading = math.pi if lane % 2 else 0.0
        along = np.arange(0.0, LANE_LENGTH_METRES, STEP_METRES)
        poses += [Pose2(start + side * x, LANE_METRES * lane, heading) for x in along.tolist()]
        end = poses[-1]
        for step in range(1, TURN_STEPS if lane < LANES - 1 else 0):
            share = step / TURN_STEPS
            turn = end.theta + side * math.pi * share
            x, y = end.x + side * 0.05 * step, end.y + LANE_METRES * share
            poses.append(Pose2(x, y, turn))
    return poses


class World:
    """A floor, and a camera over it."""

    def __init__(self, floor: str) -> None:
        camera = photograph.make_camera(CAMERA)
        surface = floors.make_floor(floor, FloorOptions(wear=0.5), FLOOR_METRES_PER_PIXEL, seed=5)
        self._photographer = photograph.Photographer(photograph.World(surface), camera)
        self.floor, self.camera, self.poses = floor, camera, lanes()

    def take(self, pose: Pose2, number: int) -> NDArray[np.uint8]:
        """Return a picture with noise of its own."""
        generator = np.random.default_rng([7, number])
        quiet = DisturbanceOptions()
        return photograph.take(self._photographer, (pose, pose), 0.0, quiet, generator)

    def map(self) -> FloorMap:
        """Return the map of the drive."""
        mapper = Mapper(self.camera)
        for number, pose in enumerate(self.poses):
            mapper.update(self.take(pose, number))
        mapper.finish()
        floor_map = mapper.floor_map()
        assert floor_map is not None
        return floor_map

    def unseen(self, count: int) -> Iterator[tuple[Pose2, NDArray[np.uint8]]]:
        """Yield poses at which the camera sees floor of the map, at any heading, and pictures."""
        generator = np.random.default_rng(3)
        middle = Pose2(MIDDLE_METRES)
        for number in range(count):
            base = self.poses[int(generator.integers(len(self.poses)))]
            away = Pose2(
                *generator.uniform(-0.05, 0.05, 2).tolist(), generator.uniform(-math.pi, math.pi)
            )
            pose = base @ middle @ away @ middle.inverse()
            yield pose, self.take(pose, 10_000 + number)

    def outside(self, count: int) -> Iterator[NDArray[np.uint8]]:
        """Yield pictures of floor outside the map."""
        generator = np.random.default_rng(4)
        for number in range(count):
            place = generator.uniform(*OUTSIDE_METRES, 2).tolist()
            pose = Pose2(*place, generator.uniform(-math.pi, math.pi))
            yield self.take(pose, 100_000 + number)


@dataclass
class Outcome:
    """Counts of the outcomes of localisation."""

    right: int = 0
    wrong: int = 0
    not_here: int = 0
    worst_metres: float = 0.0

    def count(self, found: PoseEstimate, true: Pose2) -> None:
        """Add one frame; the map's first pose is the world's origin."""
        if found.map_from_robot is None:
            self.not_here += 1
            return
        error = true.inverse() @ found.map_from_robot
        if error.translation_length < NEAR_METRES and abs(error.theta) < NEAR_RADIANS:
            self.right += 1
            self.worst_metres = max(self.worst_metres, error.translation_length)
        else:
            self.wrong += 1


def search(world: World, floor_map: FloorMap, count: int) -> None:
    """Print a row: how many of `count` frames are found, and of half as many outside."""
    locator, outcome = Locator(floor_map), Outcome()
    for pose, picture in world.unseen(count):
        outcome.count(locator.locate(picture), pose)
    outside = [locator.locate(picture) for picture in world.outside(count // 2)]
    false = sum(estimate.map_from_robot is not None for estimate in outside)
    share, worst = outcome.right / count, outcome.worst_metres * 1e3
    print(
        f"| {world.floor} | {len(floor_map.keyframes)} | {share:.1%} of {count} "
        f"| {outcome.wrong} | {outcome.not_here} | {worst:.2f} | {false} of {len(outside)} |",
        flush=True,
    )


def filled(floor_map: FloorMap, count: int) -> FloorMap:
    """Return the map with `count` keyframes: its own, and others of floor far away."""
    generator = np.random.default_rng(8)
    own = floor_map.keyframes[:count]
    pool = np.concatenate([keyframe.features.descriptors for keyframe in own])
    keyframes, estimates = list(own), list(floor_map.estimates)
    first = max(estimate.index for estimate in estimates) + 1
    for number in range(count - len(own)):
        like = own[number % len(own)]
        chosen = pool[generator.integers(len(pool), size=len(like.features))]
        flipped = np.packbits(generator.random((len(chosen), 8 * pool.shape[1])) < FLIPPED_SHARE, 1)
        features = replace(like.features, descriptors=chosen ^ flipped)
        index, pose = first + number, Pose2(100.0 + 0.3 * number)
        name = f"filled {number}"
        keyframes.append(Keyframe(index, name, None, features, like.image, like.mask))
        covariance = np.eye(3) * 1e-6
        estimates.append(PoseEstimate(index, name, None, pose, "tracked", "", 0, covariance))
    return replace(floor_map, keyframes=tuple(keyframes), estimates=tuple(estimates))


def cost(world: World, floor_map: FloorMap, count: int) -> None:
    """Print a row: milliseconds a frame in a map of `count` keyframes."""
    locator, outcome = Locator(filled(floor_map, count)), Outcome()
    seconds = {True: [0.0], False: [0.0]}
    pictures = [(pose, picture) for pose, picture in world.unseen(COST_FRAMES)]
    away = [(None, picture) for picture in world.outside(COST_FRAMES // 2)]
    false = 0
    for number, (true, picture) in enumerate([*pictures, *away]):
        prepared = locator.prepare(Frame(number, str(number), None, picture))
        started = time.process_time()
        found = locator.place(prepared)
        seconds[true is not None].append(time.process_time() - started)
        if true is None:
            false += found.map_from_robot is not None
        else:
            outcome.count(found, true)
    here, outside = (1e3 * float(np.mean(seconds[known][1:])) for known in (True, False))
    print(
        f"| {count} | {here:.0f} | {outside:.0f} | {outcome.right / COST_FRAMES:.0%} | "
        f"{outcome.wrong} | {false} of {len(away)} |",
        flush=True,
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--floors", default="asphalt,carpet")
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--keyframes", default="100,1000,10000")
    options = parser.parse_args()
    worlds = [World(name) for name in options.floors.split(",")]
    maps = [world.map() for world in worlds]
    print("| keyframes | ms, on the map | ms, outside | found | wrong | false outside |")
    print("|---" * 6 + "|", flush=True)
    for count in map(int, options.keyframes.split(",")):
        cost(worlds[0], maps[0], count)
    print("\n| floor | keyframes | found | wrong | not here | worst mm | false outside |")
    print("|---" * 7 + "|", flush=True)
    for world, floor_map in zip(worlds, maps, strict=True):
        search(world, floor_map, options.frames)


if __name__ == "__main__":
    main()
