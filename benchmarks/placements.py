"""The map of a simulated drive, beside its truth: which links and frames are false."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.projection import project_floor
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, Link, PoseEstimate
from slamcli.core.telemetry import OdometryReading
from slamcli.core.trajectory import Accuracy
from slamcli.io.poses import write_poses
from slamcli.io.trajectories import read_trajectory
from slamcli.mapping.mapper import Mapper
from slamcli.stages.evaluation import evaluate

FALSE_METRES, FALSE_DEGREES = 0.02, 1.0
# An edge is found to half a pixel at each of its points, which are 5 mm apart; it is seen where a
# metre across it is so many pixels: a line of 25 mm is 4 wide.
EDGE_SPACING_METRES = 0.005
EDGE_SIGMA_PIXELS = 0.5
MIN_PIXELS_PER_METRE = 160.0
# All three degrees of a motion are fixed when its worst direction is known so well.
MAX_SIGMA_METRES, MAX_SIGMA_DEGREES = 0.003, 0.5


@dataclass(frozen=True)
class Placements:
    """A map and what of it is false.

    Attributes
    ----------
    estimates : list of PoseEstimate
    links : list of Link
        From pictures, of all that they determine, and not switched off.
    false_links : list of (Link, Pose2)
        Those, and their errors.
    false_frames : list of int
        Tracked frames that are false beside the frame tracked before them in their fragment.
    seconds : float
        Of the mapper.
    keyframes : int
    """

    estimates: list[PoseEstimate]
    links: list[Link]
    false_links: list[tuple[Link, Pose2]]
    false_frames: list[int]
    seconds: float
    keyframes: int

    @property
    def tracked(self) -> set[int]:
        """Indices of the frames that pictures placed."""
        return {e.index for e in self.estimates if e.status == "tracked"}

    @property
    def fragments(self) -> int:
        """Number of connected maps."""
        return len({e.fragment for e in self.estimates if e.map_from_robot is not None})

    def fragment_of(self, index: int) -> int:
        """Return which connected map a frame belongs to; -1 when lost."""
        return next((e.fragment for e in self.estimates if e.index == index), -1)

    def describe(self) -> list[str]:
        """Return lines about false links and frames that are not tracked."""
        lines = [
            f"  {link.kind} {link.a}-{link.b} off by {error.x:.3f} {error.y:.3f} m "
            f"{math.degrees(error.theta):.1f} degrees, {link.inliers} inliers, "
            f"score {link.score:.4f}"
            for link, error in self.false_links
        ]
        untracked = [e for e in self.estimates if e.status != "tracked"]
        return lines + [f"  {e.index} {e.status}: {e.reason}" for e in untracked]


def is_false(error: Pose2) -> bool:
    """Return whether a motion is so wrong that accepting it was false."""
    return error.translation_length > FALSE_METRES or abs(math.degrees(error.theta)) > FALSE_DEGREES


def place(
    frames: Iterable[Frame],
    truth: Sequence[Pose2],
    calibration: Calibration,
    options: MapperOptions | None = None,
    odometry: Sequence[OdometryReading] = (),
) -> Placements:
    """Map the frames of a drive, whose indices are those of its true poses."""
    mapper = Mapper(calibration, options or MapperOptions())
    seconds, frames = 0.0, list(frames)
    for frame in frames:
        start = time.perf_counter()
        if odometry:
            mapper.odometry(odometry[frame.index])
        mapper.update(frame)
        seconds += time.perf_counter() - start
    start = time.perf_counter()
    estimates = mapper.finish(
        prepare_again=lambda indices: [mapper.prepare(frames[index]) for index in indices]
    )
    seconds += time.perf_counter() - start
    links = [
        link
        for number, link in enumerate(mapper.links)
        if link.kind in ("step", "loop") and number not in mapper.switched_off
    ]
    errors = [
        (link, (truth[link.a].inverse() @ truth[link.b]).inverse() @ link.a_from_b)
        for link in links
    ]
    false_links = [(link, error) for link, error in errors if is_false(error)]
    floor_map = mapper.floor_map()
    keyframes = 0 if floor_map is None else len(floor_map.keyframes)
    false_frames = _false_frames(estimates, truth)
    return Placements(estimates, links, false_links, false_frames, seconds, keyframes)


def accuracy(estimates: Sequence[PoseEstimate], drive: Path) -> Accuracy:
    """Return the errors of a map's poses against the truth in a drive's folder."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "poses.csv"
        write_poses(path, estimates)
        truth = read_trajectory(drive / "truth.csv")
        return evaluate(read_trajectory(path), truth, tolerance_seconds=0.01, delta=1).whole


def _false_frames(estimates: Sequence[PoseEstimate], truth: Sequence[Pose2]) -> list[int]:
    latest: dict[int, PoseEstimate] = {}
    false = []
    for estimate in estimates:
        if estimate.status != "tracked" or estimate.map_from_robot is None:
            continue
        before = latest.get(estimate.fragment)
        latest[estimate.fragment] = estimate
        if before is None or before.map_from_robot is None:
            continue
        moved = before.map_from_robot.inverse() @ estimate.map_from_robot
        true = truth[before.index].inverse() @ truth[estimate.index]
        if is_false(true.inverse() @ moved):
            false.append(estimate.index)
    return false


def fixes_motion(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    poses: tuple[Pose2, Pose2],
    calibration: Calibration,
) -> bool:
    """Return whether the edges that two frames share fix all three degrees of their motion.

    By the world alone: the information of all edge points (N, 2) that lie in both pictures, each
    of which tells the motion along its normal (N, 2).
    """
    shared = np.ones(len(points), bool)
    for pose in poses:
        robot, across = pose.inverse().apply(points), _turned(normals, -pose.theta)
        pixels, seen = project_floor(calibration, robot)
        beside, _ = project_floor(calibration, robot + 1e-4 * across)
        per_metre = 1e4 * np.linalg.norm(beside - pixels, axis=1)
        shared &= seen & (per_metre >= MIN_PIXELS_PER_METRE)
    if shared.sum() < 3:
        return False
    robot, across, fineness = robot[shared], across[shared], per_metre[shared]
    turning = across[:, 1] * robot[:, 0] - across[:, 0] * robot[:, 1]
    rows = np.column_stack([across, turning]) * (fineness / EDGE_SIGMA_PIXELS)[:, None]
    information = rows.T @ rows
    if np.linalg.eigvalsh(information)[0] < 1.0:
        return False
    covariance = np.linalg.inv(information)
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    turn = math.degrees(math.sqrt(float(covariance[2, 2])))
    return worst <= MAX_SIGMA_METRES and turn <= MAX_SIGMA_DEGREES


def _turned(vectors: NDArray[np.float64], radians: float) -> NDArray[np.float64]:
    cosine, sine = math.cos(radians), math.sin(radians)
    return vectors @ np.array([[cosine, sine], [-sine, cosine]])
