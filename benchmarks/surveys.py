"""A survey of nadir frames without a calibration, beside the `pyorthomosaic` package.

Run: make bench, or python benchmarks/surveys.py [--rows N] [--columns N] [--size WxH]. Each runs in
a process of its own, one after the other, on the same frames: frames used, RMSE of the frames'
corners in the map after one similarity onto the truth, pixels of a frame, seconds, and processor
seconds, which other work on the machine hardly changes. Shuffled, the same frames have names in
another order.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import rocked
from slamcli.core.geometry import apply_homography, invert
from slamcli.io.map_file import load_map
from slamcli.survey.projection import LOG_SCALE, STATES, project

FOCAL_WIDTHS, NOISE_GRAY, JPEG_QUALITY = 1.1, 2.0, 92
ALONG, ACROSS, JITTER_PIXELS = 0.54, 0.575, 8.0
TURN_RADIANS, SCALE_SHARE = 0.05, 0.05
PEER = """
import sys
from orthomosaic import build_orthomosaic
build_orthomosaic(sys.argv[1], sys.argv[2])
"""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=7)
    parser.add_argument("--columns", type=int, default=7)
    parser.add_argument("--size", default="800x600", metavar="WxH")
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    print(f"{'':<16} {'used':>7} {'RMSE px':>8} {'s':>7} {'CPU s':>7}")
    with tempfile.TemporaryDirectory() as folder:
        frames, shuffled = Path(folder) / "frames", Path(folder) / "shuffled"
        corners = photograph(frames, arguments.rows, arguments.columns, (width, height))
        order = np.random.default_rng(1).permutation(len(corners))
        shuffled.mkdir()
        for number, frame in enumerate(order.tolist()):
            (shuffled / f"{number:03}.jpg").write_bytes((frames / f"{frame:03}.jpg").read_bytes())
        run_slam("slam", frames, corners)
        run_slam("slam, shuffled", shuffled, corners[order])
        if importlib.util.find_spec("orthomosaic") is None:
            print("pyorthomosaic    not installed: pip install pyorthomosaic")
        else:
            run_peer(frames, corners, (width, height))


def photograph(folder: Path, rows: int, columns: int, size: tuple[int, int]) -> Float64Array:
    """Write a serpentine of frames; return (N, 4, 2) the corners' places in pixels of the floor."""
    folder.mkdir()
    states, floor_size = serpentine(rows, columns, size)
    floor = texture(floor_size)
    homographies = project(states, FOCAL_WIDTHS * size[0]).image_from_map
    middle = np.array([[1.0, 0.0, (size[0] - 1) / 2], [0.0, 1.0, (size[1] - 1) / 2], [0, 0, 1.0]])
    for number, homography in enumerate(homographies):
        noise = np.random.default_rng(number)
        # Rows of the floor's picture run down, the map's y up.
        seen = cv2.warpPerspective(
            floor, middle @ homography @ np.diag([1.0, -1.0, 1.0]), size, flags=cv2.INTER_CUBIC
        )
        noisy = np.clip(seen + noise.normal(0.0, NOISE_GRAY, seen.shape), 0, 255).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        cv2.imwrite(str(folder / f"{number:03}.jpg"), cv2.merge([noisy] * 3), quality)
    return np.array([apply_homography(invert(one), frame_corners(size)) for one in homographies])


def serpentine(
    rows: int, columns: int, size: tuple[int, int]
) -> tuple[Float64Array, tuple[int, int]]:
    """Return the states of a flight in strips, and the size of the floor below."""
    generator = np.random.default_rng(7)
    along, across = ALONG * size[0], ACROSS * size[1]
    states = np.zeros((rows * columns, STATES))
    for number in range(len(states)):
        row, column = divmod(number, columns)
        column = column if row % 2 == 0 else columns - 1 - column
        states[number, :2] = 0.6 * size[0] + along * column, -0.64 * size[1] - across * row
    states[:, :2] += generator.uniform(-JITTER_PIXELS, JITTER_PIXELS, (len(states), 2))
    states[:, 2] = generator.uniform(-TURN_RADIANS, TURN_RADIANS, len(states))
    scales = generator.uniform(1.0 - SCALE_SHARE, 1.0 + SCALE_SHARE, len(states))
    states[:, LOG_SCALE] = np.log(scales)
    floor = 1.2 * size[0] + along * (columns - 1), 1.28 * size[1] + across * (rows - 1)
    return states, (round(floor[0]), round(floor[1]))


def texture(size: tuple[int, int]) -> UInt8Array:
    """Return a floor with texture of several sizes."""
    generator = np.random.default_rng(3)
    floor = np.zeros(size[::-1], np.float32)
    for grain in (2, 5, 14, 40, 120):
        cells = generator.standard_normal((size[1] // grain + 2, size[0] // grain + 2))
        floor += cv2.resize(cells.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    smooth = cv2.GaussianBlur(floor, (0, 0), 0.8)
    return np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def frame_corners(size: tuple[int, int]) -> Float64Array:
    """Return (4, 2) pixels from the picture's middle."""
    half = (np.array(size) - 1) / 2
    return half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def run_slam(label: str, frames: Path, truth: Float64Array) -> None:
    """Print slam's row."""
    output = frames.parent / "map"
    command = (sys.executable, "-m", "slamcli", "stitch", frames, "-o", output, "--overwrite")
    seconds = timed(command)
    floor_map = load_map(output, for_locating=False)
    calibration, corners = floor_map.calibration, {}
    size = calibration.image_size
    for one in floor_map.estimates:
        if one.map_from_robot is not None and one.fragment == 0:
            own = calibration if one.rocking is None else rocked(calibration, one.rocking)
            pixels = frame_corners(size) + (np.array(size) - 1) / 2
            floor = apply_homography(own.robot_from_image, undistort_points(own, pixels))
            corners[one.index] = one.map_from_robot.apply(floor)
    print_row(label, corners, truth, seconds)


def run_peer(frames: Path, truth: Float64Array, size: tuple[int, int]) -> None:
    """Print the peer's row."""
    output = frames.parent / "peer.tif"
    seconds = timed((sys.executable, "-c", PEER, frames, output))
    report = json.loads((frames.parent / "peer_report.json").read_text(encoding="utf-8"))
    pixels = frame_corners(size) + (np.array(size) - 1) / 2
    corners = {}
    for name, camera in report["cameras"].items():
        affine = np.array(camera["affine"])
        corners[int(Path(name).stem)] = pixels @ affine[:, :2].T + affine[:, 2]
    print_row("pyorthomosaic", corners, truth, seconds)


def timed(command: Sequence[object]) -> tuple[float, float]:
    """Run a command; return its seconds and its processor seconds."""

    def processor() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    started, before = time.monotonic(), processor()
    subprocess.run([str(part) for part in command], check=False, capture_output=True)
    return time.monotonic() - started, processor() - before


def print_row(
    label: str,
    corners: dict[int, Float64Array],
    truth: Float64Array,
    seconds: tuple[float, float],
) -> None:
    """Print frames used, RMSE of the corners after one similarity, seconds."""
    found = np.concatenate([corners[number] for number in sorted(corners)]) @ [1.0, 1.0j]
    there = np.concatenate([truth[number] for number in sorted(corners)]) @ [1.0, 1.0j]
    # Maps with rows that run down are mirrored.
    errors = [rmse(one, there) for one in (found, found.conj())]
    share = f"{len(corners)}/{len(truth)}"
    cost = " ".join(f"{some:>7.1f}" for some in seconds)
    print(f"{label:<16} {share:>7} {min(errors):>8.3f} {cost}", flush=True)


def rmse(found: np.ndarray, there: np.ndarray) -> float:
    """Return the root mean square distance of complex places after one similarity."""
    z, w = found - found.mean(), there - there.mean()
    return float(np.sqrt(np.mean(np.abs(np.vdot(z, w) / np.vdot(z, z) * z - w) ** 2)))


if __name__ == "__main__":
    main()
