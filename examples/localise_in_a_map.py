"""Find single pictures in a finished map (relocalisation), without any idea where they are.

python examples/localise_in_a_map.py out/map.slam later/*.jpg
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import cv2

import slamcli


def main() -> None:
    """Print for each picture where the robot was, and how surely, or that it is not there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path, help="map.slam, by `slam stitch`")
    parser.add_argument("pictures", type=Path, nargs="+")
    arguments = parser.parse_args()

    # Made once: it builds the index of all keyframes. Every picture is then looked up by itself.
    locator = slamcli.Locator(slamcli.load_map(arguments.map))
    for path in arguments.pictures:
        picture = cv2.imread(str(path))
        if picture is None:
            print(f"{path.name}: not a picture")
            continue
        estimate = locator.locate(picture)
        pose, covariance = estimate.map_from_robot, estimate.covariance
        if pose is None or covariance is None:
            print(f"{path.name}: {estimate.reason}")
            continue
        sigma = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
        print(
            f"{path.name}: x {pose.x:.4f} m, y {pose.y:.4f} m (sigma {1000 * sigma:.2f} mm), "
            f"heading {math.degrees(pose.theta):.2f} degrees, score {estimate.score:.4f}"
        )


if __name__ == "__main__":
    main()
