"""Comparison with peers on the same frames: cv2.Stitcher and the `stitching` package.

Run: make bench, or python benchmarks/peers.py [--frames N ...] [--size WxH] [--floor NAME] [--drive
FOLDER | --folder FRAMES --calibration YAML] [--peers NAME ...] [--limit SECONDS] [--json FILE]. A
drive is what `slam simulate` has written and kept, of which the first N frames are taken; its truth
gives the fidelity. The peers cannot make bird's-eye views, so they are given them, by `slam warp`;
making those does not count. Each runs in a process of its own, for --limit seconds and in 12 GB at
most, so that three tools end within a quarter of an hour: wall and processor time and peak
memory are the whole process's. Fidelity is measured on the floor that the result shows, after the
best similarity onto the true floor (SIFT, RANSAC), for the peers' maps have no scale: peak signal
to noise ratio after one gain, structural similarity (Wang et al., IEEE Trans. Image Processing
13(4), 2004), gradient energy as a share of the truth's.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.geometry import Grid, Pose2
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import list_frames
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import FloorOptions

SLAM = (sys.executable, "-m", "slamcli")
# Where the simulator's course drives start in the floor's own frame.
COURSE_START = Pose2(-0.45, -0.45, 0.0)
TRUTH_METRES_PER_PIXEL = 0.002
VIEW_METRES_PER_PIXEL = 0.002
# Of address space, for each tool: of 100 frames the `stitching` package takes all that there is.
MAX_BYTES = 12 * 2**30

OPENCV = """
import sys, cv2
cv2.ocl.setUseOpenCL(False)
images = [cv2.imread(name) for name in sys.argv[2:]]
stitcher = cv2.Stitcher_create(cv2.Stitcher_SCANS)
status, picture = stitcher.stitch(images)
print("placed", len(stitcher.component()) if status == 0 else 0, "status", status)
if status == 0:
    cv2.imwrite(sys.argv[1], picture)
"""
PACKAGE = """
import sys, cv2
from stitching import AffineStitcher
stitcher = AffineStitcher(confidence_threshold=0.3, crop=False)
picture = stitcher.stitch(sys.argv[2:])
print("placed", len(stitcher.images.names))
cv2.imwrite(sys.argv[1], picture)
"""
PEERS = {"scans": ("cv2.Stitcher SCANS", OPENCV), "stitching": ("stitching, affine", PACKAGE)}


@dataclass(frozen=True)
class Outcome:
    """Result of one tool on the frames."""

    tool: str
    wall_seconds: float
    processor_seconds: float
    peak_megabytes: float
    placed: int
    frames: int
    psnr_decibels: float = math.nan
    ssim: float = math.nan
    sharpness: float = math.nan
    remark: str = ""


def run(tool: str, command: list[str], frames: int, limit: float) -> tuple[Outcome, str]:
    """Run a tool to its end, or to the limit; return what it took, and what it printed."""
    measured = [sys.executable, "-c", _MEASURE, str(limit), str(MAX_BYTES), *command]
    done = subprocess.run(measured, capture_output=True, text=True)
    wall, processor, peak, code = done.stdout.strip().splitlines()[-1].split()
    remark = "" if code == "0" else (done.stderr.strip().splitlines() or [f"exit {code}"])[-1][:70]
    if float(wall) >= limit:
        remark = "timed out"
    figures = (float(wall), float(processor), float(peak) / 1e3)
    return Outcome(tool, *figures, 0, frames, remark=remark), done.stdout


_MEASURE = """
import resource, subprocess, sys, time
started = time.perf_counter()
most = int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_AS, (most, most))
try:
    code = subprocess.call(sys.argv[3:], timeout=float(sys.argv[1]))
except subprocess.TimeoutExpired:
    code = 1
used = resource.getrusage(resource.RUSAGE_CHILDREN)
wall = time.perf_counter() - started
print(wall, used.ru_utime + used.ru_stime, used.ru_maxrss, code)
"""


def slam(frames: Path, calibration: Path, output: Path, count: int, limit: float) -> Outcome:
    """Map the camera's own images, at the resolution of the peers' views."""
    command = [*SLAM, "stitch", str(frames), "-c", str(calibration), "-o", str(output)]
    command += ["--metres-per-pixel", str(VIEW_METRES_PER_PIXEL)]
    outcome, _ = run("slam stitch", command, count, limit)
    rows = list(csv.DictReader((output / "poses.csv").open()))
    placed = sum(bool(row["x"]) for row in rows)
    return Outcome(**{**asdict(outcome), "placed": placed})


def peer(tool: str, script: str, views: list[Path], output: Path, limit: float) -> Outcome:
    """Stitch bird's-eye views by a peer."""
    command = [sys.executable, "-c", script, str(output), *map(str, views)]
    outcome, printed = run(tool, command, len(views), limit)
    found = [line.split() for line in printed.splitlines() if line.startswith("placed")]
    placed = int(found[-1][1]) if found and output.exists() else 0
    return Outcome(**{**asdict(outcome), "placed": placed})


def true_floor(name: str, drive: Path, seed: int, count: int) -> NDArray[np.uint8]:
    """Return the floor around the first frames of a simulated drive."""
    rows = list(csv.DictReader((drive / "truth.csv").open()))[:count]
    start = COURSE_START if name == "course" else Pose2()
    places = start.apply([(float(row["x"]), float(row["y"])) for row in rows])
    corners = np.vstack([places.min(axis=0) - 1.5, places.max(axis=0) + 1.5])
    grid = Grid.covering(corners, TRUTH_METRES_PER_PIXEL)
    resolution = photograph.texture_metres_per_pixel(load_calibration(drive / "camera.yaml"))
    floor = floors.make_floor(name, FloorOptions(wear=0.5), resolution, seed)
    return floor.region(grid)


def fidelity(picture: NDArray[np.uint8], truth: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Return PSNR (dB), SSIM and sharpness of a map that lies anywhere on the true floor."""
    gray = cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2GRAY)
    floor = cv2.cvtColor(truth, cv2.COLOR_BGR2GRAY)
    shown = picture[..., 3] > 0 if picture.shape[2] == 4 else gray > 0
    sift = cv2.SIFT_create(6000)
    first, described = sift.detectAndCompute(gray, shown.astype(np.uint8) * 255)
    second, others = sift.detectAndCompute(floor, None)
    pairs = cv2.BFMatcher().knnMatch(described, others, k=2)
    good = [a for a, b in pairs if a.distance < 0.8 * b.distance]
    if len(good) < 8:
        return math.nan, math.nan, math.nan
    source = np.array([first[match.queryIdx].pt for match in good])
    target = np.array([second[match.trainIdx].pt for match in good])
    cv2.setRNGSeed(0)
    matrix, _ = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=3.0)
    size = (floor.shape[1], floor.shape[0])
    moved = cv2.warpAffine(gray, matrix, size, flags=cv2.INTER_AREA).astype(np.float32)
    seen = cv2.warpAffine(shown.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST)
    inside = cv2.erode(seen, np.ones((9, 9), np.uint8)) > 0
    return likeness(moved, floor.astype(np.float32), inside)


def likeness(
    shown: NDArray[np.float32], true: NDArray[np.float32], inside: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Return PSNR (dB), SSIM, sharpness of a gray picture that lies on the truth, by one gain."""
    shown = shown * np.float32((shown[inside] * true[inside]).sum() / (shown[inside] ** 2).sum())
    error = float(np.mean((shown - true)[inside] ** 2))
    energies = [
        float(
            (cv2.Sobel(one, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(one, cv2.CV_32F, 0, 1) ** 2)[
                inside
            ].mean()
        )
        for one in (shown, true)
    ]
    return (
        10 * math.log10(255**2 / error),
        similarity(shown, true, inside),
        energies[0] / energies[1],
    )


def similarity(a: NDArray[np.float32], b: NDArray[np.float32], inside: NDArray[np.bool_]) -> float:
    """Return the mean structural similarity of two pictures."""

    def smooth(image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5))

    mean_a, mean_b = smooth(a), smooth(b)
    variance_a, variance_b = smooth(a * a) - mean_a**2, smooth(b * b) - mean_b**2
    covariance = smooth(a * b) - mean_a * mean_b
    first, second = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    index = (2 * mean_a * mean_b + first) * (2 * covariance + second)
    index /= (mean_a**2 + mean_b**2 + first) * (variance_a + variance_b + second)
    return float(index[inside].mean())


def compare(
    frames: Path,
    calibration: Path,
    work: Path,
    truth: NDArray[np.uint8] | None,
    peers: list[str],
    limit: float,
) -> list[Outcome]:
    """Run slam stitch and its peers on the same frames."""
    files = list_frames([frames])
    views = work / "views"
    scale = str(VIEW_METRES_PER_PIXEL)
    warp = [*SLAM, "warp", str(frames), "-c", str(calibration), "-o", str(views)]
    subprocess.run([*warp, "--metres-per-pixel", scale], check=True, capture_output=True)
    flat = []
    for path in sorted(views.glob("*.png")):
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        flat.append(path.with_suffix(".bmp"))
        cv2.imwrite(str(flat[-1]), picture)
    # Else the first tool would run while a gigabyte is still being written to the disk.
    os.sync()
    outcomes = [slam(frames, calibration, work / "map", len(files), limit)]
    results = [work / "map" / "mosaic.png"]
    for tool, script in (PEERS[name] for name in peers):
        results.append(work / f"{tool.split()[0].strip(',')}.png")
        outcomes.append(peer(tool, script, flat, results[-1], limit))
    if truth is None:
        return outcomes
    measured = []
    for outcome, result in zip(outcomes, results, strict=True):
        picture = cv2.imread(str(result), cv2.IMREAD_UNCHANGED) if result.exists() else None
        values = (math.nan,) * 3 if picture is None else fidelity(picture, truth)
        names = ("psnr_decibels", "ssim", "sharpness")
        measured.append(Outcome(**{**asdict(outcome), **dict(zip(names, values, strict=True))}))
    return measured


def table(outcomes: list[Outcome]) -> str:
    """Return the outcomes as a table in Markdown, wall time in multiples of the first's too."""
    head = "| tool | wall s | x | CPU s | peak MB | placed | PSNR dB | SSIM | sharpness | |"
    lines = [head, "|" + "---|" * 10]
    for one in outcomes:
        times = one.wall_seconds / outcomes[0].wall_seconds
        lines.append(
            f"| {one.tool} | {one.wall_seconds:.1f} | {times:.1f} | {one.processor_seconds:.1f} | "
            f"{one.peak_megabytes:.0f} | {one.placed}/{one.frames} | {one.psnr_decibels:.1f} | "
            f"{one.ssim:.3f} | {one.sharpness:.2f} | {one.remark} |"
        )
    return "\n".join(lines)


def simulate(drive: Path, floor: str, frames: int, size: str, length: float) -> None:
    """Make a drive to compare on."""
    options = ["--floor", floor, "--frames", str(frames), "--size", size, "--length", str(length)]
    command = [*SLAM, "simulate", str(drive), *options, "--path", "loop", "--no-light"]
    subprocess.run(command, check=True, capture_output=True)


def begun(drive: Path, count: int, work: Path) -> Path:
    """Return a folder of links to the first frames of a drive."""
    first = work / "frames"
    first.mkdir()
    for path in sorted((drive / "frames").iterdir())[:count]:
        (first / path.name).symlink_to(path.resolve())
    return first


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[100])
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--floor", default="asphalt")
    parser.add_argument("--length", type=float, default=None)
    parser.add_argument("--drive", type=Path, help="of slam simulate, on the same floor")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--limit", type=float, default=360.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors")
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        drive = arguments.drive or work / "drive"
        if arguments.drive is None and arguments.folder is None:
            most = max(arguments.frames)
            simulate(drive, arguments.floor, most, arguments.size, arguments.length or 0.06 * most)
        for count in arguments.frames if arguments.folder is None else [0]:
            here = work / str(count)
            here.mkdir()
            if arguments.folder is not None:
                found = compare(
                    arguments.folder,
                    arguments.calibration,
                    here,
                    None,
                    arguments.peers,
                    arguments.limit,
                )
            else:
                frames, truth = (
                    begun(drive, count, here),
                    true_floor(arguments.floor, drive, 0, count),
                )
                camera = drive / "camera.yaml"
                found = compare(frames, camera, here, truth, arguments.peers, arguments.limit)
            print(table(found), flush=True)
            outcomes += found
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(one) for one in outcomes], indent=1))


if __name__ == "__main__":
    main()
