"""Map frames whose true poses are known, and fail when the map is worse than a limit.

    python examples/evaluate_against_truth.py samples/course calibration.yaml --limit-mm 1

The folder holds `frames/` and `truth.csv` (as `slam simulate` writes them). Use it as a regression
test of your own camera, floor and options.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

import slamcli


def main() -> None:
    """Print ATE, RPE and NEES; exit 1 when the ATE is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path, help="folder with frames/ and truth.csv")
    parser.add_argument("calibration", type=Path)
    parser.add_argument("--limit-mm", type=float, default=1.0)
    parser.add_argument("--frames", type=int, help="map only the first of them")
    arguments = parser.parse_args()

    mapper = slamcli.Mapper(slamcli.load_calibration(arguments.calibration))
    names = sorted(path.name for path in (arguments.drive / "frames").iterdir())
    for index, name in enumerate(names[: arguments.frames]):
        picture = cv2.imread(str(arguments.drive / "frames" / name))
        mapper.update(slamcli.Frame(index, name, None, picture))

    with tempfile.TemporaryDirectory() as folder:
        poses = Path(folder) / "poses.csv"
        with poses.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(("frame", "x", "y", "heading"))
            for estimate in mapper.finish():
                if (pose := estimate.map_from_robot) is not None:
                    writer.writerow((estimate.name, pose.x, pose.y, pose.theta))
        command = [sys.executable, "-m", "slamcli", "evaluate", str(poses)]
        command += [str(arguments.drive / "truth.csv"), "--json"]
        found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)

    print(json.dumps(found, indent=2))
    part = found["fragments"][0]
    ate_mm = 1000.0 * part["absolute"]["rmse"]
    print(f"ATE {ate_mm:.3f} mm, limit {arguments.limit_mm:g} mm")
    sys.exit(ate_mm > arguments.limit_mm)


if __name__ == "__main__":
    main()
