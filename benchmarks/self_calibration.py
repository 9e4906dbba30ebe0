"""Accuracy of `slam stitch --self-calibrate` from a wrong camera: floors x paths.

Run: python benchmarks/self_calibration.py [--worlds a,b] [--frames N] [--size WxH] [--seed N]
[--keep FOLDER] [--json FILE]. Each world is simulated by `slam simulate` with k1 = -0.2, and mapped
twice with a camera whose pitch is off by 2 degrees, whose focal length is off by 5 % and whose
distortion is unknown: as it is, and refined by the frames. Some worlds expect another verdict: a
right camera is to be confirmed, and a straight line does not determine the focal length. With
--keep FOLDER results stay there, and existing ones are not made again.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from slamcli.core.camera.footprint import choose_max_range
from slamcli.io.calibrations import load_calibration, save_calibration
from slamcli.stages import adjustment

SLAM = (sys.executable, "-m", "slamcli")
K1, FOCAL_SHARE, PITCH_DEGREES = -0.2, 0.05, 2.0


@dataclass(frozen=True)
class World:
    """A drive, whether its camera is known wrongly, and what the verdict on it should be."""

    floor: str
    path: str
    length_metres: float = 4.0
    wrong: bool = True
    verdict: str = "refined"
    more: tuple[str, ...] = ()


WORLDS = {
    f"{floor}_{path}": World(floor, path)
    for floor in ("asphalt", "concrete", "course")
    for path in ("loop", "lawnmower")
} | {
    "concrete_rocking": World(
        "concrete", "loop", more=("--rocking", "0.3", "--bounce", "0.002", "--boxes", "4")
    ),
    "asphalt_right": World("asphalt", "loop", wrong=False, verdict="confirmed"),
    "asphalt_line": World("asphalt", "line", 3.0, verdict="not applied"),
    "asphalt_line_right": World("asphalt", "line", 3.0, wrong=False, verdict="not applied"),
}


@dataclass(frozen=True)
class Outcome:
    """Verdict, errors of the camera left (focal length as a share), and of the map."""

    world: str
    expected: str
    verdict: str
    focal_share: float
    k1: float
    pitch_degrees: float
    roll_degrees: float
    placed: int
    frames: int
    ate_before_millimetres: float
    ate_after_millimetres: float
    pixels_before: float
    pixels_after: float


def run(*arguments: object) -> str:
    """Return what the slam command prints."""
    command = [*SLAM, *(str(argument) for argument in arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def simulate(folder: Path, world: World, frames: int, size: str, seed: int) -> None:
    """Simulate the drive, and write the wrong camera beside the right one."""
    if not (folder / "camera.yaml").exists():
        drive = ("--floor", world.floor, "--path", world.path, "--length", world.length_metres)
        camera = ("--frames", frames, "--size", size, "--seed", seed, "--k1", K1, "--no-light")
        run("simulate", folder, *drive, *camera, *world.more)
    right = load_calibration(folder / "camera.yaml")
    off = np.zeros(7)
    off[0], off[1], off[3] = math.log1p(FOCAL_SHARE), -K1, math.radians(PITCH_DEGREES)
    wrong = adjustment.changed(right, off)
    seen = choose_max_range(wrong.camera_matrix, wrong.image_from_robot, wrong.image_size)
    save_calibration(folder / "wrong.yaml", replace(wrong, max_range_metres=seen))


def ate_millimetres(folder: Path, world: Path) -> tuple[float, int, int]:
    """Return the absolute trajectory error, the frames placed and all frames."""
    found = json.loads(run("evaluate", folder / "poses.csv", world / "truth.csv", "--json"))
    part = found["fragments"][0]
    return 1000.0 * part["absolute"]["rmse"], found["matched"], found["truth_poses"]


def measure(folder: Path, name: str) -> Outcome:
    """Map a simulated world with and without the camera's refinement."""
    world = WORLDS[name]
    given = folder / ("wrong.yaml" if world.wrong else "camera.yaml")
    for output, option in (("before", "--no-self-calibrate"), ("after", "--self-calibrate")):
        if not (folder / output / "run.toml").exists():
            run("stitch", folder / "frames", "-c", given, "-o", folder / output, option)
    run_toml = tomllib.loads((folder / "after" / "run.toml").read_text(encoding="utf-8"))
    section = run_toml["self_calibration"]
    right = load_calibration(folder / "camera.yaml")
    before, _, _ = ate_millimetres(folder / "before", folder)
    after, placed, frames = ate_millimetres(folder / "after", folder)
    return Outcome(
        name,
        world.verdict,
        section["verdict"],
        section["focal_pixels"] / float(right.camera_matrix[0, 0]) - 1.0,
        section["k1"] - float(right.distortion[0]),
        section["pitch_degrees"] - math.degrees(right.pitch_radians),
        section["roll_degrees"] - math.degrees(right.roll_radians),
        placed,
        frames,
        before,
        after,
        section.get("pixels_before", math.nan),
        section.get("pixels_after", math.nan),
    )


def row(found: Outcome) -> str:
    """Return one line of the table."""
    verdict = found.verdict
    if verdict != found.expected:
        verdict += f" (expected: {found.expected})"
    return (
        f"| {found.world} | {verdict} | {found.focal_share:+.3%} | {found.k1:+.4f} "
        f"| {found.pitch_degrees:+.4f} | {found.roll_degrees:+.4f} | {found.placed}/{found.frames} "
        f"| {found.ate_before_millimetres:.2f} | {found.ate_after_millimetres:.2f} "
        f"| {found.pixels_before:.2f} | {found.pixels_after:.2f} |"
    )


def main() -> None:
    """Print a table, world by world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--frames", type=int, default=44)
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    titles = "world, verdict, focal length, k1, pitch °, roll °, placed, ATE mm before, after"
    columns = [*titles.split(", "), "matches px before", "after"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    outcomes = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.worlds.split(","):
            folder = (arguments.keep or Path(scratch)) / name
            simulate(folder, WORLDS[name], arguments.frames, arguments.size, arguments.seed)
            outcomes.append(measure(folder, name))
            print(row(outcomes[-1]), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(found) for found in outcomes], indent=2))


if __name__ == "__main__":
    main()
