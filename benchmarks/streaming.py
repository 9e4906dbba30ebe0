"""Cost of streaming: each frame beside bare ORB and matching of the same frame, in the same run.

Run: python benchmarks/streaming.py [--floors a,b] [--frames N] [--size WxH] [--metres-per-pixel M]
[--profile ROWS]. One thread. A loop of 8 m over a simulated floor is mapped frame by frame with
`Mapper.update`, as a robot would; after each frame `cv2.ORB_create(1000).detectAndCompute` of it
and a Hamming match with the frame before are timed. Compare ratios, not milliseconds, between
machines. With --profile, the functions that took most are listed, by their own time.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import subprocess
import sys
import time
from dataclasses import dataclass

import cv2
import numpy as np
from drives import Drive, make_drive
from numpy.typing import NDArray

from slamcli.core.config import MapperOptions
from slamcli.core.records import PoseEstimate
from slamcli.core.robust import fit_rigid_2d
from slamcli.mapping.mapper import Mapper
from slamcli.simulation.config import CameraOptions, SimulationOptions

FLOORS = ("asphalt", "course", "carpet", "tiles", "planks")
# A circle on the board of a course is smaller.
LOOP_METRES = {"course": 2.8}
POINTS = 1000
COLD_START = """
import sys, time
from pathlib import Path
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import read_image
from slamcli.mapping.mapper import Mapper
folder = Path(sys.argv[1])
image = read_image(folder / "frames" / "0000.jpg")
Mapper(load_calibration(folder / "camera.yaml")).update(image)
print(time.process_time())
"""


@dataclass(frozen=True)
class Streamed:
    """A drive that was mapped frame by frame.

    Attributes
    ----------
    seconds, bare_seconds : (N,) float64
        Of this thread, for each frame: the mapper, and the bare kernels.
    estimates : list of PoseEstimate
        As finished.
    """

    seconds: NDArray[np.float64]
    bare_seconds: NDArray[np.float64]
    estimates: list[PoseEstimate]


def stream(
    drive: Drive, count: int, options: MapperOptions, profile: cProfile.Profile | None
) -> Streamed:
    """Map a drive frame by frame, and time the bare kernels between."""
    mapper = Mapper(drive.calibration, options)
    orb, matcher = cv2.ORB_create(POINTS), cv2.BFMatcher(cv2.NORM_HAMMING)
    before, seconds, bare_seconds = None, [], []
    for index in range(count):
        frame = drive.frame(index)
        started = time.thread_time()
        if profile is not None:
            profile.enable()
        mapper.update(frame)
        if profile is not None:
            profile.disable()
        seconds.append(time.thread_time() - started)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        started = time.thread_time()
        _, now = orb.detectAndCompute(gray, None)
        if before is not None and now is not None:
            matcher.match(now, before)
        bare_seconds.append(time.thread_time() - started)
        before = now
    return Streamed(np.array(seconds), np.array(bare_seconds), mapper.finish())


def ate_millimetres(drive: Drive, estimates: list[PoseEstimate]) -> float:
    """Return the root mean square of the placed frames' distances from the truth, aligned."""
    placed = [(e.index, e.map_from_robot) for e in estimates if e.map_from_robot is not None]
    ours = np.array([(pose.x, pose.y) for _, pose in placed])
    theirs = np.array([(drive.truth[i].x, drive.truth[i].y) for i, _ in placed])
    apart = fit_rigid_2d(theirs, ours).apply(ours) - theirs
    return 1e3 * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def cold_start_seconds(drive: Drive) -> float:
    """Return the processor time of imports, the mapper and its first frame, in a new process."""
    command = [sys.executable, "-c", COLD_START, str(drive.folder)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    """Print a row for each floor."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--floors", default=",".join(FLOORS))
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--metres-per-pixel", type=float, help="of the views")
    parser.add_argument("--profile", type=int, default=0)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    width, height = (int(side) for side in arguments.size.split("x"))
    options = MapperOptions(metres_per_pixel=arguments.metres_per_pixel)
    print(
        "| floor | median ms | bare ms | ratio | p99 ratio | placed | fragments | ATE mm | cold s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for floor in arguments.floors.split(","):
        drive = make_drive(
            SimulationOptions(
                floor=floor,
                frames=arguments.frames,
                length_metres=LOOP_METRES.get(floor, 8.0),
                camera=CameraOptions(size=(width, height)),
            )
        )
        profile = cProfile.Profile(time.thread_time) if arguments.profile else None
        done = stream(drive, arguments.frames, options, profile)
        bare = float(np.median(done.bare_seconds))
        middle, late = np.median(done.seconds), np.percentile(done.seconds, 99)
        placed = [e for e in done.estimates if e.map_from_robot is not None]
        print(
            f"| {floor} | {1e3 * middle:.1f} | {1e3 * bare:.1f} | {middle / bare:.2f} "
            f"| {late / bare:.2f} | {len(placed)}/{len(done.estimates)} "
            f"| {len({e.fragment for e in placed})} "
            f"| {ate_millimetres(drive, done.estimates):.3f} | {cold_start_seconds(drive):.2f} |",
            flush=True,
        )
        if profile is not None:
            pstats.Stats(profile).sort_stats("tottime").print_stats(arguments.profile)


if __name__ == "__main__":
    main()
