"""Trajectory error of long drives: as a chain, with loops closed, and by plain ORB.

Run: python benchmarks/accuracy.py [--drives a,b] [--keep FOLDER] [--json FILE]. Each drive is made
by `slam simulate` and mapped by `slam stitch` with its true calibration, with `--no-loops` and
without. The plain chain beside them gets the same bird's-eye views by the true homography: ORB,
ratio test, cv2.estimateAffinePartial2D, from frame to frame. Aligned with the truth as
`slam evaluate` does it. NEES is 3 when the sigmas are consistent. With --keep FOLDER results stay
there, and existing ones are not made again.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from robustness import plain_motions

from slamcli.core.geometry import Pose2
from slamcli.core.trajectory import Trajectory
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import read_image
from slamcli.io.trajectories import read_trajectory
from slamcli.stages.evaluation import evaluate

SLAM = (sys.executable, "-m", "slamcli")
DRIVES = {
    "loop": ("asphalt", "loop", 36.0, 1000),
    "lawnmower": ("asphalt", "lawnmower", 21.0, 300),
    "carpet-loop": ("carpet", "loop", 36.0, 1000),
    "course-lawnmower": ("course", "lawnmower", 8.0, 300),
}
MAPPINGS = {"open": "--no-loops", "closed": "--loops"}


@dataclass(frozen=True)
class Outcome:
    """Result of one mapping of one drive."""

    drive: str
    mapping: str
    placed: int
    frames: int
    fragments: int
    path_metres: float
    ate_millimetres: float
    ate_share: float
    rpe_millimetres: float
    heading_degrees: float
    nees: float
    within: float


def simulate(folder: Path, drive: str, seed: int) -> None:
    """Take a drive's frames, unless they are there."""
    if not (folder / "truth.csv").exists():
        floor, path, length, frames = DRIVES[drive]
        course = ("--no-light", "--floor", floor, "--path", path, "--length", str(length))
        run("simulate", str(folder), *course, "--frames", str(frames), "--seed", str(seed))


def run(*arguments: str) -> None:
    """Run the slam command."""
    subprocess.run([*SLAM, *arguments], check=True, capture_output=True)


def stitch(folder: Path, mapping: str) -> Trajectory:
    """Return a drive's poses, mapped now unless they are there."""
    output = folder / mapping
    if not (output / "poses.csv").exists():
        made = ("-c", str(folder / "camera.yaml"), "-o", str(output), MAPPINGS[mapping])
        # The mosaic is not what is measured.
        small = ("--metres-per-pixel", "0.01", "--no-obstacles", "--no-gain")
        run("stitch", str(folder / "frames"), *made, *small)
    return read_trajectory(output / "poses.csv")


def plain(folder: Path) -> Trajectory:
    """Return the poses of the plain chain; it ends at the first motion that it does not find."""
    calibration = load_calibration(folder / "camera.yaml")
    files = sorted((folder / "frames").iterdir())
    poses = [Pose2()]
    for motion in plain_motions(calibration, map(read_image, files)):
        if motion is None:
            break
        poses.append(poses[-1] @ motion)
    names = tuple(file.name for file in files[: len(poses)])
    table = np.array([[p.x, p.y, p.theta] for p in poses])
    fragments = np.zeros(len(poses), np.int64)
    return Trajectory(table, None, names, fragments, None, len(files) - len(poses))


def measure(folder: Path, drive: str, mapping: str) -> Outcome:
    """Compare one mapping with the truth."""
    poses = plain(folder) if mapping == "plain ORB" else stitch(folder, mapping)
    found = evaluate(poses, read_trajectory(folder / "truth.csv"), tolerance_seconds=0.01, delta=1)
    whole = found.whole
    consistency = whole.consistency
    return Outcome(
        drive,
        mapping,
        found.matched,
        found.truth_poses,
        len(found.fragments),
        whole.path_metres,
        1e3 * whole.absolute.rmse,
        whole.absolute_share_of_path,
        1e3 * whole.relative.rmse,
        whole.heading.rmse,
        math.nan if consistency is None else consistency.nees,
        math.nan if consistency is None else consistency.within_95_percent,
    )


def row(found: Outcome) -> str:
    """Return one line of the table."""
    sigmas = "" if math.isnan(found.nees) else f"{found.nees:.2f} | {found.within:.0%}"
    return (
        f"| {found.drive} | {found.mapping} | {found.placed}/{found.frames} | {found.fragments} "
        f"| {found.path_metres:.2f} | {found.ate_millimetres:.3f} | {found.ate_share:.4%} "
        f"| {found.rpe_millimetres:.3f} | {found.heading_degrees:.4f} | {sigmas or ' | '} |"
    )


def main() -> None:
    """Print a table, drive by drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", default="loop,lawnmower", help=", ".join(DRIVES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(
        "| drive | mapping | placed | fragments | path m | ATE mm | of the path | RPE mm "
        "| heading degrees | NEES | within 95 % |"
    )
    print("|" + "---|" * 11)
    outcomes = []
    with tempfile.TemporaryDirectory() as scratch:
        for drive in arguments.drives.split(","):
            folder = (arguments.keep or Path(scratch)) / drive
            simulate(folder, drive, arguments.seed)
            for mapping in ("plain ORB", *MAPPINGS):
                outcomes.append(measure(folder, drive, mapping))
                print(row(outcomes[-1]), flush=True)
    if arguments.json:
        arguments.json.write_text(
            json.dumps([asdict(found) for found in outcomes], indent=2) + "\n"
        )


if __name__ == "__main__":
    main()
