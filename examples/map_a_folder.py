"""Map a folder of frames from Python, and read what comes of it.

    python examples/map_a_folder.py samples/course/frames calibration.yaml out

The command does the work (it paints the mosaic, resumes, exports); this script runs it and reads
poses.csv and map.slam.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from pathlib import Path

import slamcli


def main() -> None:
    """Map the folder, then print where each frame was, or why that is not known."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path, nargs="+", help="a folder, or picture files")
    parser.add_argument("calibration", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()

    command = [sys.executable, "-m", "slamcli", "stitch", *map(str, arguments.frames)]
    command += ["-c", str(arguments.calibration), "-o", str(arguments.output), "--overwrite"]
    # 0: done; 3: written, but incomplete (most frames lost); anything else: nothing was written.
    code = subprocess.run(command, check=False).returncode
    if code not in {0, 3}:
        sys.exit(code)

    with (arguments.output / "poses.csv").open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            if row["status"] == "lost":
                print(f"{row['frame']}: lost: {row['reason']}")
            else:
                print(f"{row['frame']}: x {row['x']} m, y {row['y']} m, heading {row['heading']}")

    floor_map = slamcli.load_map(arguments.output / "map.slam")
    print(f"{len(floor_map.keyframes)} keyframes and {len(floor_map.links)} links in map.slam")


if __name__ == "__main__":
    main()
