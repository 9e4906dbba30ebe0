"""Real frames of other people's planes, as a user would stitch them: no calibration, no option.

SLAMCLI_DATA=DATA python benchmarks/real_sets.py [SET ...]

A row a set: frames in the largest map, maps, seconds, ATE after one similarity where there is
truth, correlation of the heights with the truth's, the median distance, in the map, of SIFT
matches that are found independently of slamcli (OpenCV's defaults, a homography for each pair of
neighbours), and how many of the same frames OpenCV's Stitcher uses (SCANS).
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import rocked
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import apply_homography
from slamcli.core.records import PoseEstimate
from slamcli.io.frames import FrameFile, list_frames, read_frame
from slamcli.io.map_file import load_map
from slamcli.run.session.session import Session
from slamcli.run.stitch import stitch
from slamcli.run.stitch.options import StitchOptions

SETS = ("seabed1", "seabed2", "seabed5", "seabed6", "copr", "seneca", "cfn", "starrynight")
MATCHES, RATIO, THRESHOLD_PIXELS = 2000, 0.7, 4.0
NEIGHBOURS = 2


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", default=SETS, metavar="SET")
    data = Path(os.environ.get("SLAMCLI_DATA", ""))
    titles = f"{'set':<12} {'largest':>8} {'maps':>4} {'s':>6} {'ATE':>8} {'height':>7}"
    print(f"{titles} {'SIFT px':>8} {'SCANS':>6}")
    for name in parser.parse_args().sets:
        folder = data / "real" / name
        if not folder.is_dir():
            sys.exit(f"{folder} is missing; set SLAMCLI_DATA to the folder of the test data")
        print(row(name, folder), flush=True)


def row(name: str, folder: Path) -> str:
    """Return the row of one set."""
    with tempfile.TemporaryDirectory() as output:
        started = time.monotonic()
        options = StitchOptions(MapperOptions())
        stitch([folder], None, Path(output) / "map", options, overwrite=False, session=Session())
        seconds = time.monotonic() - started
        floor_map = load_map(Path(output) / "map", for_locating=False)
    placed = [one for one in floor_map.estimates if one.map_from_robot is not None]
    sizes = np.bincount([one.fragment for one in placed])
    largest = [one for one in placed if one.fragment == int(sizes.argmax())]
    ate, correlation = against_truth(folder, largest)
    files = {file.name: file for file in list_frames([folder])}
    distance = independent_distance(floor_map.calibration, placed, files)
    share = f"{len(largest)}/{len(files)}"
    return (
        f"{name:<12} {share:>8} {len(sizes):>4} {seconds:>6.1f} {ate:>8.3g} {correlation:>7.2f} "
        f"{distance:>8.2f} {used_by_scans(list(files.values())):>6}"
    )


def used_by_scans(files: list[FrameFile]) -> int:
    """Return how many of the frames OpenCV's Stitcher registers, at its own settings."""
    pictures = [read_frame(file).image for file in files]
    stitcher = cv2.Stitcher.create(cv2.Stitcher_SCANS)
    try:
        done = stitcher.estimateTransform(pictures) == cv2.Stitcher_OK
    except cv2.error:
        return 0
    return len(stitcher.component()) if done else 0


def against_truth(folder: Path, placed: list[PoseEstimate]) -> tuple[float, float]:
    """Return the ATE after one similarity, and the height's correlation; nan without."""
    path = folder / "truth.csv"
    if not path.is_file():
        return math.nan, math.nan
    with path.open(encoding="utf-8") as stream:
        truth = {Path(line["frame"]).stem: line for line in csv.DictReader(stream)}
    lines = [truth[Path(one.name).stem] for one in placed]
    metric = "east_metres" in lines[0]
    columns = ("east_metres", "north_metres") if metric else ("x_pixels", "y_pixels")
    there = np.array([[float(line[key]) for key in columns] for line in lines])
    there[:, 1] *= 1.0 if metric else -1.0
    poses = [one.map_from_robot for one in placed]
    z = np.array([complex(pose.x, pose.y) for pose in poses if pose is not None])
    w = (there - there.mean(axis=0)) @ [1.0, 1.0j]
    z = z - z.mean()
    error = np.vdot(z, w) / np.vdot(z, z) * z - w
    ate = float(np.sqrt(np.mean(np.abs(error) ** 2)))
    if not metric or any(one.rocking is None for one in placed):
        return ate, math.nan
    heights = [one.rocking.height_metres for one in placed if one.rocking is not None]
    scales = [float(line["metres_per_pixel"]) for line in lines]
    return ate, float(np.corrcoef(heights, scales)[0, 1])


def independent_distance(
    calibration: Calibration, placed: list[PoseEstimate], files: dict[str, FrameFile]
) -> float:
    """Return the median distance in the map of independent matches of near frames."""
    described = {}
    for one in placed:
        file = replace(files[one.name], canvas=calibration.image_size)
        described[one.index] = sift(read_frame(file, gray=True).image)
    distances = []
    by_index = {one.index: one for one in placed}
    for first in placed:
        for step in range(1, NEIGHBOURS + 1):
            second = by_index.get(first.index + step)
            if second is None or second.fragment != first.fragment:
                continue
            pixels = matches(described[first.index], described[second.index])
            floor = [
                on_map(calibration, one, points)
                for one, points in zip((first, second), pixels, strict=True)
            ]
            distances.append(np.linalg.norm(floor[0] - floor[1], axis=1))
    return float(np.median(np.concatenate(distances))) if distances else math.nan


def sift(gray: np.ndarray) -> tuple[Float64Array, np.ndarray]:
    """Return places and descriptors, by OpenCV's defaults."""
    points, descriptors = cv2.SIFT.create(MATCHES).detectAndCompute(gray, None)
    return np.asarray(cv2.KeyPoint.convert(points), np.float64).reshape(-1, 2), descriptors


def matches(
    first: tuple[Float64Array, np.ndarray], second: tuple[Float64Array, np.ndarray]
) -> tuple[Float64Array, Float64Array]:
    """Return (N, 2) pixels in both pictures of the matches of one homography."""
    none = np.empty((0, 2))
    if first[1] is None or second[1] is None or min(len(first[0]), len(second[0])) < 8:
        return none, none
    pairs = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
    good = [one for one, other in pairs if one.distance < RATIO * other.distance]
    if len(good) < 15:
        return none, none
    a = first[0][[one.queryIdx for one in good]]
    b = second[0][[one.trainIdx for one in good]]
    cv2.setRNGSeed(0)
    _, mask = cv2.findHomography(b, a, cv2.RANSAC, THRESHOLD_PIXELS)
    inside = np.zeros(len(a), bool) if mask is None else np.asarray(mask).ravel() > 0
    return (a[inside], b[inside]) if inside.sum() >= 15 else (none, none)


def on_map(calibration: Calibration, one: PoseEstimate, pixels: Float64Array) -> Float64Array:
    """Return (N, 2) places in the map of pixels of a frame."""
    own = calibration if one.rocking is None else rocked(calibration, one.rocking)
    assert one.map_from_robot is not None
    floor = apply_homography(own.robot_from_image, undistort_points(own, pixels))
    return np.asarray(one.map_from_robot.apply(floor), np.float64)


if __name__ == "__main__":
    main()
