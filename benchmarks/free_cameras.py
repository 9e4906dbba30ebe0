"""Cameras that move freely over a simulated floor in light, with what is known of them or without.

Run: python benchmarks/free_cameras.py [--worlds a,b] [--frames N] [--keep FOLDER]. A row for each
world and way to map it: frames placed in the largest map, ATE after one similarity (a rigid motion
where the camera is given) as a share of the path, and, where the camera looks ahead, the errors of
its focal length, pitch and roll. Nadir cameras drift in heading, rise and sink by 10 % and tilt by
3 degrees at most about; hand-held ones rock by 3 degrees and bounce by 2 cm at 0.3 m. With --keep
FOLDER results stay there, and existing ones are not made again.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import path_length
from slamcli.core.records import PoseEstimate
from slamcli.io.calibrations import load_calibration
from slamcli.io.map_file import load_map
from slamcli.io.trajectories import read_path
from slamcli.survey.ground import below_camera

SLAM = (sys.executable, "-m", "slamcli")
FOLDER = "{folder}"
UNKNOWN, INTRINSICS, CALIBRATED = "unknown", "intrinsics", "calibrated"
WAYS: dict[str, tuple[str, ...]] = {
    UNKNOWN: (),
    INTRINSICS: ("--intrinsics", f"{FOLDER}/camera.yaml"),
    CALIBRATED: ("-c", f"{FOLDER}/camera.yaml"),
}
# One standard deviation of tilt, and of a height of 0.3 m: 3 degrees and 10 % are met now and then.
NADIR = ("--pitch", "90", "--square-side", "0.15", "--rocking", "1.5", "--bounce", "0.015")
HAND = ("--rocking", "3", "--bounce", "0.02")


@dataclass(frozen=True)
class World:
    """A world, and the ways to map it."""

    options: tuple[str, ...]
    ways: tuple[str, ...] = (UNKNOWN,)


def oblique(number: int) -> World:
    """Return the world of a camera drawn by chance."""
    generator = np.random.default_rng([number, 21])
    floor = ("asphalt", "concrete", "terrazzo", "parquet", "road")[number % 5]
    camera = {
        "--field-of-view": generator.uniform(50.0, 80.0),
        "--k1": generator.uniform(-0.25, 0.05),
        "--pitch": generator.uniform(25.0, 55.0),
        "--roll": generator.uniform(-4.0, 4.0),
        "--height": generator.uniform(0.2, 0.5),
    }
    path = ("loop", "lawnmower")[number % 2]
    named = [part for name, value in camera.items() for part in (name, f"{value:.4g}")]
    return World(("--floor", floor, "--path", path, "--length", "6", "--seed", str(number), *named))


WORLDS = {
    **{
        f"nadir_{floor}_{path}": World(
            (*NADIR, "--floor", floor, "--path", path, "--length", "6", "--lane", "0.2"), ways
        )
        for (floor, path), ways in {
            ("asphalt", "drift"): tuple(WAYS),
            ("concrete", "lawnmower"): tuple(WAYS),
            ("terrazzo", "drift"): tuple(WAYS),
            ("carpet", "lawnmower"): tuple(WAYS),
        }.items()
    },
    **{f"oblique_{number}": oblique(number) for number in range(10)},
    "straight": World(("--path", "line", "--length", "4")),
    **{
        f"hand_{floor}": World(
            (*HAND, "--floor", floor, "--path", path, "--length", "6"), (CALIBRATED,)
        )
        for floor, path in (("asphalt", "loop"), ("concrete", "lawnmower"), ("terrazzo", "loop"))
    },
}


def main() -> None:
    """Print the table, world by world."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", default=",".join(WORLDS))
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    print(
        "| world | camera | placed | ATE, share of the path | focal length | pitch ° | roll ° | s |"
    )
    print("|---" * 8 + "|")
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.worlds.split(","):
            folder = (arguments.keep or Path(scratch)) / name
            world = WORLDS[name]
            if not (folder / "camera.yaml").exists():
                slam("simulate", folder, "--frames", arguments.frames, *world.options)
            for way in world.ways:
                print(f"| {name} | {way} | {measure(folder, way)} |", flush=True)


def slam(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command of slam."""
    command = [*SLAM, *(str(argument) for argument in arguments)]
    return subprocess.run(command, check=False, capture_output=True, text=True)


def measure(folder: Path, way: str) -> str:
    """Map a world in one way, if that is not done; return what is left of its row."""
    output, seconds = folder / way, math.nan
    if not (output / "run.toml").exists():
        options = [option.replace(FOLDER, str(folder)) for option in WAYS[way]]
        started = time.monotonic()
        done = slam("stitch", folder / "frames", "-o", output, *options)
        seconds = time.monotonic() - started
        if not (output / "run.toml").exists():
            said = [line for line in done.stderr.splitlines() if "rror" in line]
            return f"refused: {' '.join(said)}"
    truth = read_path(folder / "truth.csv")
    floor_map = load_map(output, for_locating=False)
    placed = [e for e in floor_map.estimates if e.map_from_robot is not None and e.fragment == 0]
    z = np.array([below(e, floor_map.calibration) for e in placed])
    w = np.array([complex(truth[e.index].x, truth[e.index].y) for e in placed])
    z, w = z - z.mean(), w - w.mean()
    factor = np.vdot(z, w) / np.vdot(z, z)
    factor /= abs(factor) if way == CALIBRATED else 1.0
    ate = float(np.sqrt(np.mean(np.abs(factor * z - w) ** 2))) / path_length(truth)
    cells = [f"{len(placed)}/{len(truth)}", f"{ate:.3%}", *camera_errors(folder, output)]
    return " | ".join([*cells, f"{seconds:.0f}"])


def below(estimate: PoseEstimate, calibration: Calibration) -> complex:
    """Return where a camera is above the map, as a complex number."""
    pose = estimate.map_from_robot
    assert pose is not None
    place = pose.x, pose.y
    if calibration.is_top_down and estimate.rocking is not None:
        place = below_camera(pose, estimate.rocking, float(calibration.camera_matrix[0, 0]))
    return complex(*place)


def camera_errors(folder: Path, output: Path) -> list[str]:
    """Return the errors of focal length, pitch and roll that self-calibration left."""
    section = tomllib.loads((output / "run.toml").read_text(encoding="utf-8"))
    found = section.get("self_calibration")
    if found is None:
        return ["", "", ""]
    right = load_calibration(folder / "camera.yaml")
    focal = found["focal_pixels"] / float(right.camera_matrix[0, 0]) - 1.0
    pitch = found["pitch_degrees"] - math.degrees(right.pitch_radians)
    roll = found["roll_degrees"] - math.degrees(right.roll_radians)
    return [f"{focal:+.2%}", f"{pitch:+.3f}", f"{roll:+.3f}"]


if __name__ == "__main__":
    main()
