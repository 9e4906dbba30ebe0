"""Kill and resume `slam stitch` at random moments; compare each byte with an undisturbed run.

Run: python benchmarks/resume.py [--kills N] [--frames N] [--size WxH] [--seed N]. A kill is
SIGKILL, at a moment drawn evenly from the undisturbed run's duration.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SLAM = (sys.executable, "-m", "slamcli")
# Of the undisturbed run's time: before and after, there is nothing to interrupt.
EARLIEST, LATEST = 0.1, 0.98


def kill_once(command: list[str], output: Path, seconds: float) -> tuple[bool, int]:
    """Run for some seconds; return whether a state was left, and how many finished tiles."""
    with subprocess.Popen(
        [*command, "-o", str(output)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
    left = output / ".resume"
    return (left / "mapper.pickle").exists(), len(list(left.glob("tiles/*/*.npz")))


def same_files(first: Path, second: Path) -> bool:
    """Return whether two folders contain the same names with the same bytes."""
    names = sorted(path.name for path in first.iterdir())
    return names == sorted(path.name for path in second.iterdir()) and all(
        (first / name).read_bytes() == (second / name).read_bytes() for name in names
    )


def main() -> None:
    """Measure and print a line a kill."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    generator = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        drive, whole = Path(folder) / "drive", Path(folder) / "whole"
        simulate = ["--frames", str(arguments.frames), "--size", arguments.size, "--no-light"]
        subprocess.run([*SLAM, "simulate", str(drive), *simulate], check=True, capture_output=True)
        command = [*SLAM, "stitch", str(drive / "frames"), "-c", str(drive / "camera.yaml")]
        started = time.monotonic()
        subprocess.run([*command, "-o", str(whole)], check=True, capture_output=True)
        duration = time.monotonic() - started
        identical, states = 0, 0
        for number in range(arguments.kills):
            output = Path(folder) / f"cut{number}"
            seconds = duration * generator.uniform(EARLIEST, LATEST)
            state, tiles = kill_once(command, output, seconds)
            finished = (output / "poses.csv").exists()
            resumed = [*command, "-o", str(output), "--resume"]
            subprocess.run(resumed, check=True, capture_output=True)
            same = same_files(whole, output)
            identical += same
            states += state
            print(
                f"killed after {seconds:.1f} of {duration:.1f} s: "
                f"{'a state' if state else 'finished' if finished else 'no state yet'}, "
                f"{tiles} tiles; {'identical' if same else 'DIFFERENT'}",
                flush=True,
            )
        print(f"identical {identical} of {arguments.kills}; {states} with a state")


if __name__ == "__main__":
    main()
