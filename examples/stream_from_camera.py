"""Localise a camera live: one frame in, one pose out, the way a robot would use it.

python examples/stream_from_camera.py 0 calibration.yaml              # the first camera
python examples/stream_from_camera.py drive.mp4 calibration.yaml      # a video
python examples/stream_from_camera.py ./frames calibration.yaml       # a folder of pictures
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

import slamcli


def pictures(source: str) -> Iterator[np.ndarray]:
    """Yield the BGR pictures of a camera (its number), a folder or a video."""
    if Path(source).is_dir():
        for path in sorted(Path(source).iterdir()):
            picture = cv2.imread(str(path))
            if picture is not None:
                yield picture
        return
    capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    while True:
        there, picture = capture.read()
        if not there:
            break
        yield picture
    capture.release()


def main() -> None:
    """Print a line for every frame, and the final poses after the last one (or Ctrl-C)."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", help="a camera's number, a folder of pictures or a video")
    parser.add_argument("calibration", help="calibration.yaml, by `slam calibrate`")
    parser.add_argument("--frames", type=int, help="stop after this many")
    arguments = parser.parse_args()

    mapper = slamcli.Mapper(slamcli.load_calibration(arguments.calibration))
    try:
        for picture in islice(pictures(arguments.source), arguments.frames):
            # `update` never raises on a bad frame: it returns why the frame has no pose.
            estimate = mapper.update(picture)
            pose = estimate.map_from_robot
            if pose is None:
                print(f"{estimate.name}: {estimate.status}: {estimate.reason}")
                continue
            # A controller takes odom_from_robot, which never jumps; map_from_robot may jump when
            # a loop is closed. Both in metres and radians.
            print(
                f"{estimate.name}: {estimate.status} x {pose.x:.4f} m, y {pose.y:.4f} m, "
                f"heading {pose.theta:.4f} rad, map {estimate.fragment}"
            )
    except KeyboardInterrupt:
        print("stopped")

    # All remaining loops are closed here and every pose is optimised once more.
    final = mapper.finish()
    placed = [estimate for estimate in final if estimate.map_from_robot is not None]
    print(f"{len(placed)} of {len(final)} frames placed, {len(mapper.links)} links")


if __name__ == "__main__":
    main()
