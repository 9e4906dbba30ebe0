"""Localisation of single frames in a map: found, falsely placed, and the cost as maps grow.

Run: python benchmarks/locate.py [--floors a,b] [--frames N] [--keyframes 100,1000,10000]
[--size WxH]. Two tables. The cost: a camera takes keyframes a hand's breadth apart over one field
of lanes, up to a thousand, at known poses; a map of more has each of them again, as later passes
over the same floor would see them: so much of its points, each a little elsewhere and with some
bits of its descriptor turned over, and points of their own. Frames that the map has not seen are
looked up in it, without a prior and with one, and timed beside `cv2.ORB_create(1000)` of the same
picture; and a robot is followed along a lane. Processor time on one thread. What is found: a camera
drives three lanes over a simulated floor; frames at any heading are then looked up, and frames of
floor outside the map.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.geometry import Pose2
from slamcli.core.records import Features, FloorMap, Frame, Keyframe, PoseEstimate
from slamcli.mapping.keyframes import encode_keyframe
from slamcli.mapping.localizer import Follower, Locator
from slamcli.mapping.mapper import Mapper
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions

CAMERA = CameraOptions(height_metres=0.2, pitch_degrees=45.0)
FLOOR_METRES_PER_PIXEL = 0.0005
LANES, LANE_METRES, LANE_LENGTH_METRES, STEP_METRES = 3, 0.2, 1.2, 0.06
# So far ahead lies the middle of the view; about it the camera turns from lane to lane.
MIDDLE_METRES = 0.2
TURN_STEPS = 6
NEAR_METRES, NEAR_RADIANS = 0.01, math.radians(0.5)
OUTSIDE_METRES = (20.0, 60.0)
COST_FRAMES = 60
# A field of keyframes: as many see each spot as on a drive that covers a floor.
FIELD_KEYFRAMES, FIELD_LANE_METRES = 1000, 0.15
# Of a keyframe's points, those that a later pass finds again; where, as a share of their sigmas,
# and with which descriptors.
AGAIN_SHARE, AGAIN_SIGMAS, FLIPPED_SHARE = 0.6, 0.5, 0.1
# Error of a pose that is expected: of odometry between two frames.
PRIOR_METRES, PRIOR_RADIANS = 0.01, math.radians(1.0)
BARE_POINTS = 1000
# From frame to frame of a robot that is followed.
FOLLOWED_METRES = 0.02
COST_COLUMNS = (
    *("keyframes", "ORB ms", "whole map ms", "ratio", "near ms", "ratio", "outside ms", "ratio"),
    *("followed ms", "ratio", "found (whole, near, followed)", "wrong", "false outside"),
)


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

    def __init__(self, floor: str, size: tuple[int, int]) -> None:
        camera = photograph.make_camera(replace(CAMERA, size=size))
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

    def unseen(self, count: int, poses: list[Pose2]) -> Iterator[tuple[Pose2, NDArray[np.uint8]]]:
        """Yield poses at which the camera sees floor of others, at any heading, and pictures."""
        generator = np.random.default_rng(3)
        middle = Pose2(MIDDLE_METRES)
        for number in range(count):
            base = poses[int(generator.integers(len(poses)))]
            away = Pose2(
                *generator.uniform(-0.05, 0.05, 2).tolist(), generator.uniform(-math.pi, math.pi)
            )
            pose = base @ middle @ away @ middle.inverse()
            yield pose, self.take(pose, 10_000 + number)

    def followed(self, count: int) -> Iterator[tuple[Pose2, NDArray[np.uint8]]]:
        """Yield poses of a robot that swerves along the first lane, and pictures."""
        for number in range(count):
            x, swerve = FOLLOWED_METRES * number, 0.1 * FOLLOWED_METRES * number
            pose = Pose2(x, 0.03 * math.sin(20.0 * swerve), 0.06 * math.cos(20.0 * swerve))
            yield pose, self.take(pose, 200_000 + number)

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
    for pose, picture in world.unseen(count, world.poses):
        outcome.count(locator.locate(picture), pose)
    outside = [locator.locate(picture) for picture in world.outside(count // 2)]
    false = sum(estimate.map_from_robot is not None for estimate in outside)
    share, worst = outcome.right / count, outcome.worst_metres * 1e3
    print(
        f"| {world.floor} | {len(floor_map.keyframes)} | {share:.1%} of {count} "
        f"| {outcome.wrong} | {outcome.not_here} | {worst:.2f} | {false} of {len(outside)} |",
        flush=True,
    )


def field(count: int) -> list[Pose2]:
    """Return poses up and down the lanes of a square field."""
    a_lane = max(1, round(math.sqrt(count * FIELD_LANE_METRES / STEP_METRES)))
    poses = []
    for number in range(count):
        lane, step = divmod(number, a_lane)
        x, turned = STEP_METRES * step, lane % 2 == 1
        length = STEP_METRES * (a_lane - 1)
        y = FIELD_LANE_METRES * lane
        poses.append(Pose2(length - x, y, math.pi) if turned else Pose2(x, y))
    return poses


def seen_again(like: Features, others: np.ndarray, generator: np.random.Generator) -> Features:
    """Return a keyframe's features as a later pass at its pose sees them."""
    count = len(like)
    kept = generator.random(count) < AGAIN_SHARE
    points = like.points + AGAIN_SIGMAS * like.sigmas * generator.normal(size=like.points.shape)
    flipped = np.packbits(generator.random((count, 8 * others.shape[1])) < FLIPPED_SHARE, axis=1)
    new = others[generator.integers(len(others), size=count)]
    # Descriptors of nothing on this floor, but distributed as its own are.
    mixed = np.where(generator.random((count, 8 * others.shape[1])) < 0.5, 1, 0).astype(np.uint8)
    new = new ^ np.packbits(mixed, axis=1)
    descriptors = np.where(kept[:, None], like.descriptors ^ flipped, new)
    return replace(like, points=points, descriptors=descriptors)


def overlapping(world: World, count: int) -> FloorMap:
    """Return a map of `count` keyframes that overlap each other, its poses the true ones."""
    generator = np.random.default_rng(8)
    poses = field(min(count, FIELD_KEYFRAMES))
    mapper = Mapper(world.camera)
    mapper.update(world.take(poses[0], 0))
    floor_map = mapper.floor_map()
    assert floor_map is not None
    keyframes: list[Keyframe] = []
    for number, pose in enumerate(poses):
        frame = Frame(number, str(number), None, world.take(pose, number))
        keyframes.append(encode_keyframe(mapper.prepare(frame)))
    pool = np.concatenate([keyframe.features.descriptors for keyframe in keyframes])
    for number in range(len(poses), count):
        like = keyframes[number % FIELD_KEYFRAMES]
        features = seen_again(like.features, pool, generator)
        keyframes.append(replace(like, index=number, name=str(number), features=features))
        poses.append(poses[number % FIELD_KEYFRAMES])
    estimates = tuple(
        PoseEstimate(index, str(index), None, pose, "tracked", "", 0, np.eye(3) * 1e-6)
        for index, pose in enumerate(poses)
    )
    return replace(floor_map, keyframes=tuple(keyframes), estimates=estimates)


def cost(world: World, count: int) -> None:
    """Print a row: milliseconds a frame in a map of `count` keyframes, and bare ORB's."""
    locator = Locator(overlapping(world, count))
    poses = field(min(count, FIELD_KEYFRAMES))
    generator, orb = np.random.default_rng(9), cv2.ORB_create(BARE_POINTS)
    names = ("bare", "map", "near", "outside", "followed")
    seconds: dict[str, list[float]] = {name: [] for name in names}
    outcomes = {"map": Outcome(), "near": Outcome(), "followed": Outcome()}
    follower = Follower(locator)

    def timed(name: str, picture: NDArray[np.uint8], near: Pose2 | None = None) -> PoseEstimate:
        started = time.process_time()
        found = locator.locate(picture, near)
        seconds[name].append(time.process_time() - started)
        return found

    for pose, picture in world.unseen(COST_FRAMES, poses):
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        started = time.process_time()
        orb.detectAndCompute(gray, None)
        seconds["bare"].append(time.process_time() - started)
        outcomes["map"].count(timed("map", picture), pose)
        turn = float(generator.normal(0.0, PRIOR_RADIANS))
        error = Pose2(*generator.normal(0.0, PRIOR_METRES, 2).tolist(), turn)
        outcomes["near"].count(timed("near", picture, pose @ error), pose)
    for pose, picture in world.followed(COST_FRAMES):
        started = time.process_time()
        found = follower.update(picture)
        seconds["followed"].append(time.process_time() - started)
        outcomes["followed"].count(found, pose)
    away = [timed("outside", picture) for picture in world.outside(COST_FRAMES // 2)]
    false = sum(found.map_from_robot is not None for found in away)
    bare, *rest = (1e3 * float(np.median(seconds[name])) for name in seconds)
    figures = " | ".join(f"{one:.1f} | {one / bare:.2f}" for one in rest)
    shares = ", ".join(f"{one.right / COST_FRAMES:.0%}" for one in outcomes.values())
    wrong = sum(one.wrong for one in outcomes.values())
    print(f"| {count} | {bare:.1f} | {figures} | {shares} | {wrong} | {false} |", flush=True)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--floors", default="asphalt,carpet")
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--keyframes", default="100,1000,10000")
    parser.add_argument("--size", default="640x480")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    width, height = (int(side) for side in options.size.split("x"))
    worlds = [World(name, (width, height)) for name in options.floors.split(",")]
    print("| " + " | ".join(COST_COLUMNS) + " |\n" + "|---" * len(COST_COLUMNS) + "|", flush=True)
    for count in map(int, filter(None, options.keyframes.split(","))):
        cost(worlds[0], count)
    if not options.frames:
        return
    print("\n| floor | keyframes | found | wrong | not here | worst mm | false outside |")
    print("|---" * 7 + "|", flush=True)
    for world in worlds:
        search(world, world.map(), options.frames)


if __name__ == "__main__":
    main()
