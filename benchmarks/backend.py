"""Cost of the back end as a map grows: place recognition, poses and covariances, without pixels.

Run: python benchmarks/backend.py [--frames N]. A lawnmower over landmarks with binary descriptors,
an eighth of whose bits differ from view to view; every frame is a keyframe, is linked to the three
before it, and has a compass's and a GPS reading. The same again without these readings, every fifth
frame closing a loop to the lane beside it as it comes. Processor time on one thread.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from slamcli.core.camera.calibration import top_down_calibration
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Features, Link, PreparedFrame
from slamcli.core.telemetry import CompassReading, GpsReading
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.backend.sensors import Sensors
from slamcli.stages import covisibility
from slamcli.stages.place_index import PlaceIndex

SIDE_METRES = 1.28
STEP_METRES, LANE_METRES, LANE_LENGTH_METRES = 0.2, 0.8, 40.0
LANDMARKS_A_VIEW = 350
SIGMAS = np.array([0.001, 0.001, 0.001])
FRAMES_A_SECOND = 10.0
METRES_A_DEGREE = 111_320.0
LOOP_EVERY = 5


class Cost(NamedTuple):
    """Seconds of one frame."""

    place_recognition: float
    poses: float


def lawnmower(count: int) -> list[Pose2]:
    """Return poses that cover a field lane by lane."""
    a_lane = round(LANE_LENGTH_METRES / STEP_METRES)
    poses = []
    for index in range(count):
        lane, along = divmod(index, a_lane)
        back = lane % 2 == 1
        x = STEP_METRES * (a_lane - 1 - along if back else along)
        poses.append(Pose2(x, LANE_METRES * lane, math.pi if back else 0.0))
    return poses


class World:
    """Landmarks at random, seen with noise."""

    def __init__(self, poses: list[Pose2]) -> None:
        self.poses = poses
        places = pose_array(poses)[:, :2]
        low, high = places.min(axis=0) - SIDE_METRES, places.max(axis=0) + SIDE_METRES
        count = int(np.prod(high - low) * LANDMARKS_A_VIEW / SIDE_METRES**2)
        generator = np.random.default_rng(0)
        self.landmarks = low + generator.random((count, 2)) * (high - low)
        self.descriptors = generator.integers(0, 256, (count, 32), dtype=np.uint8)
        self.tree = KDTree(self.landmarks)

    def look(self, index: int) -> Features:
        """Return what a frame sees: four in five of the landmarks before it."""
        generator = np.random.default_rng([1, index])
        pose = self.poses[index]
        near = np.array(self.tree.query_ball_point([pose.x, pose.y], 0.7 * SIDE_METRES))
        points = pose.inverse().apply(self.landmarks[near])
        seen = (np.abs(points).max(axis=1) < SIDE_METRES / 2) & (generator.random(len(near)) < 0.8)
        near, points = near[seen], points[seen]
        flipped = np.packbits(generator.random((len(near), 256)) < 0.125, axis=1)
        return Features(
            (points + generator.normal(0, 0.003, points.shape)).astype(np.float32),
            self.descriptors[near] ^ flipped,
            generator.random(len(near)).astype(np.float32),
            np.full((len(near), 2), 0.003, np.float32),
            np.full(len(near), 0.3, np.float32),
            np.full(len(near), np.nan, np.float32),
        )

    def link(self, a: int, b: int, kind: str = "step") -> Link:
        """Return the motion between two frames, with noise of its covariance."""
        noise = np.random.default_rng([2, a, b]).normal(0, 1, 3) * SIGMAS
        motion = self.poses[a].inverse() @ self.poses[b] @ Pose2(*noise.tolist())
        return Link(a, b, motion, np.diag(SIGMAS**2), 100, 0.9, kind)  # type: ignore[arg-type]

    def sense(self, sensors: Sensors, index: int) -> None:
        """Add a compass and a GPS reading of a frame."""
        generator = np.random.default_rng([3, index])
        pose, stamp = self.poses[index], index / FRAMES_A_SECOND
        heading = pose.theta + generator.normal(0, math.radians(3))
        sensors.compass(CompassReading(stamp, heading, math.radians(3)))
        east, north = np.array([pose.x, pose.y]) + generator.normal(0, 2.0, 2)
        sensors.gps(GpsReading(stamp, north / METRES_A_DEGREE, east / METRES_A_DEGREE, 2.0))


def drive(world: World, backend: Backend) -> list[Cost]:
    """Return the cost of each frame, as it comes."""
    index, costs = PlaceIndex(), []
    for number in range(len(world.poses)):
        features = world.look(number)
        prepared = PreparedFrame(number, str(number), number / FRAMES_A_SECOND, None, None)
        links = [world.link(a, number) for a in range(max(0, number - 3), number)]
        world.sense(backend.sensors, number)
        started = time.process_time()
        index.query(features, frozenset(range(number - 5, number)))
        index.add(number, features)
        between = time.process_time()
        if links:
            backend.place(prepared, links)
        else:
            backend.begin_fragment(prepared)
        costs.append(Cost(between - started, time.process_time() - between))
    return costs


def stream(world: World, backend: Backend) -> list[float]:
    """Return the seconds that each frame's poses cost where loops are closed as they come."""
    a_lane, costs = round(LANE_LENGTH_METRES / STEP_METRES), []
    for number in range(len(world.poses)):
        prepared = PreparedFrame(number, str(number), None, None, None, "")
        links = [world.link(a, number) for a in range(max(0, number - 3), number)]
        loops = []
        if number >= a_lane and number % LOOP_EVERY == 0:
            beside = 2 * a_lane * (number // a_lane) - 1 - number
            loops = [world.link(beside, number, "loop")]
        started = time.process_time()
        if links:
            backend.place(prepared, links)
        else:
            backend.begin_fragment(prepared)
        if loops:
            backend.add_links(number, loops)
        costs.append(time.process_time() - started)
    return costs


def find_loops(world: World, graph: PoseGraph) -> tuple[int, list[Link], float]:
    """Return how many pairs see the same floor by the poses, their links, and the seconds."""
    started = time.process_time()
    calibration = top_down_calibration((128, 128))
    # Its views are as many metres wide as pixels.
    shrunk = pose_array([graph.pose(i) for i in range(len(world.poses))])
    shrunk[:, :2] *= 128.0 / SIDE_METRES
    found = covisibility.pairs(
        shrunk,
        np.array([(link.a, link.b) for link in graph.links]),
        np.full(len(graph.links), 0.1),
        covisibility.Footprint(calibration),
        min_overlap=0.2,
        max_uncertainty=100.0,
    )
    candidates, loops = 0, []
    for pairs in found:
        far = [int(a) for a in pairs.a if pairs.b - a > 5]
        candidates += len(far)
        loops += far[:1] and [(far[0], pairs.b)]
    seconds = time.process_time() - started
    return candidates, [world.link(a, b, "loop") for a, b in loops], seconds


def peak_megabytes() -> float:
    """Return the peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    count = parser.parse_args().frames
    world = World(lawnmower(count))
    base = peak_megabytes()
    backend = Backend(Sensors())
    costs = drive(world, backend)
    print(f"| frames | ms a frame, place recognition | poses | worst of a frame |\n{'|---' * 4}|")
    tenth = max(1, count // 10)
    for first in range(0, count, tenth):
        some = np.array(costs[first : first + tenth]) * 1e3
        recognition, poses = some.mean(axis=0)
        worst = some.sum(axis=1).max()
        print(f"| to {first + len(some)} | {recognition:.2f} | {poses:.2f} | {worst:.0f} |")
    means = np.array(costs).sum(axis=1)
    share = means[-tenth:].mean() / means[:tenth].mean()
    candidates, loops, search = find_loops(world, backend.graph)
    started = time.process_time()
    backend.solve(loops)
    solve = time.process_time() - started
    total = means.sum() + search + solve
    print(f"\nlast tenth to first, a frame: {share:.2f}")
    print(f"candidates by poses: {candidates} in {search:.1f} s")
    links = len(backend.graph.links)
    print(f"{links} links and {2 * count} readings solved, covariances: {solve:.1f} s")
    print(f"whole back end: {total:.1f} s; peak memory {peak_megabytes() - base:.0f} MB")
    streamed = np.array(stream(world, Backend())) * 1e3
    print(f"\n| frames | ms a frame, loops closed as they come | worst |\n{'|---' * 3}|")
    for first in range(0, count, tenth):
        some = streamed[first : first + tenth]
        print(f"| to {first + len(some)} | {some.mean():.2f} | {some.max():.0f} |")


if __name__ == "__main__":
    main()
