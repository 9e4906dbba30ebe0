"""Draws the pictures of the documentation, by the commands that its pages show (`make figures`).

Every picture is made of what the commands write for `samples/` and one simulated drive. It takes
some minutes, nearly all of it the simulation.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
COURSE = ROOT / "samples" / "course"
MAX_BYTES = 150_000
GAP_PIXELS = 12
LAWNMOWER = ("--path", "lawnmower", "--length", 10, "--lane", 0.45)
LOOP = ("--path", "loop", "--length", 4, "--frames", 50)
LINK_COLOURS = {"step": (60, 160, 60), "loop": (40, 40, 220)}


def main() -> None:
    """Run the commands in a folder of their own, then compose the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        draw_course(work)
        draw_planks(work)
        draw_obstacles(work)


def draw_course(work: Path) -> None:
    """Draw one picture a stage of the pipeline, from the sample drive."""
    calibration, first, second = work / "calibration.yaml", "0006.jpg", "0007.jpg"
    frames = [COURSE / "frames" / name for name in (first, second)]
    slam("calibrate", COURSE / "square.png", "--side", 0.3048, "-o", calibration)
    slam("warp", frames[0], "-c", calibration, "-o", work / "views")
    slam("detect", frames[0], "-c", calibration, "-o", work / "points", "--count", 1000)
    features = ("match", *frames, "-c", calibration, "--features", "orb")
    slam(*features, "--count", 1000, "-o", work / "matches.png")
    # With more inliers needed than there are points, the pixels are searched.
    slam(*features, "--min-inliers", 5000, "-o", work / "search.png")
    stitch = ("stitch", COURSE / "frames", "-c", calibration, "-o", work / "map")
    slam(*stitch, "--export", "links", "--layers", "resolution,views,last-frame")
    save("calibration.jpg", read(calibration.with_suffix(".png"), width=1200))
    save("view.jpg", beside([read(frames[0]), read(work / "views" / "0006.png")], height=420))
    save("keypoints.jpg", read(work / "points" / "0006_keypoints.png", width=560))
    save("matches.jpg", read(work / "matches.png", width=1200))
    save("correlation.jpg", read(work / "search.png", width=1200))
    save("pose-graph.jpg", pose_graph(work / "map", width=760))
    layers = ("mosaic", "resolution", "views", "last-frame")
    save("layers.jpg", beside([read(work / "map" / f"{name}.png") for name in layers], height=260))


def draw_planks(work: Path) -> None:
    """Draw the picture of the README: a frame, and the map with the robot's way on it."""
    out = mapped(work / "drive", "--floor", "planks", *LAWNMOWER)
    frame = work / "drive" / "frames" / "0030.jpg"
    save("map.jpg", beside([read(frame), pose_graph(out, 1600)], height=340))


def draw_obstacles(work: Path) -> None:
    """Draw a map, and the boxes that stood on its floor."""
    out = mapped(work / "boxes", "--floor", "terrazzo", "--size", "480x360", *LOOP, "--boxes", 5)
    names = ("mosaic", "obstacles")
    save("obstacles.jpg", beside([read(out / f"{name}.png") for name in names], height=420))


def mapped(drive: Path, *options: object) -> Path:
    """Return the folder of the map of a simulated drive."""
    slam("simulate", drive, *options)
    slam("calibrate", drive / "square.png", "-o", drive / "calibration.yaml")
    out = drive.with_name(f"{drive.name}_map")
    slam("stitch", drive, "-o", out)
    return out


def slam(*arguments: object) -> None:
    """Run a command as a user would."""
    subprocess.run([sys.executable, "-m", "slamcli", *map(str, arguments)], check=True, cwd=ROOT)


def pose_graph(folder: Path, width: int) -> np.ndarray:
    """Return a map with its links drawn on it: steps green, loop closures red."""
    picture = read(folder / "mosaic.png")
    # A world file: metres a pixel, two turns, minus metres a pixel, and the first pixel's place.
    scale, _, _, _, left, top = map(float, (folder / "mosaic.pgw").read_text().split())
    with (folder / "poses.csv").open(newline="") as stream:
        poses = {row["index"]: row for row in csv.DictReader(stream) if row["x"]}
    pixels = {
        index: (round((float(row["x"]) - left) / scale), round((top - float(row["y"])) / scale))
        for index, row in poses.items()
    }
    thick = max(2, picture.shape[1] // 400)
    links = folder / "links.csv"
    if links.exists():
        with links.open(newline="") as stream:
            for row in csv.DictReader(stream):
                colour = LINK_COLOURS.get(row["kind"])
                if colour and row["a"] in pixels and row["b"] in pixels:
                    cv2.line(
                        picture, pixels[row["a"]], pixels[row["b"]], colour, thick, cv2.LINE_AA
                    )
    way = np.array([pixels[index] for index in poses], np.int32)
    if not links.exists():
        cv2.polylines(picture, [way], isClosed=False, color=LINK_COLOURS["loop"], thickness=thick)
    for place in way.tolist():
        cv2.circle(picture, place, 2 * thick, (255, 255, 255), cv2.FILLED, cv2.LINE_AA)
        cv2.circle(picture, place, 2 * thick, (40, 40, 40), thick // 2, cv2.LINE_AA)
    return resized(picture, width / picture.shape[1])


def read(path: Path, width: int | None = None) -> np.ndarray:
    """Return a picture as BGR: on white where transparent; counts and lengths in colours."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None, path
    if picture.dtype != np.uint8:
        seen = picture > 0
        high = float(np.percentile(picture[seen], 98)) if seen.any() else 1.0
        gray = np.clip(picture * (255.0 / high), 0, 255).astype(np.uint8)
        picture = np.where(seen[..., None], cv2.applyColorMap(gray, cv2.COLORMAP_VIRIDIS), 255)
    elif picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    elif picture.shape[2] == 4:
        opaque = picture[:, :, 3:] / 255.0
        picture = picture[:, :, :3] * opaque + 255.0 * (1.0 - opaque)
    picture = np.ascontiguousarray(picture, np.uint8)
    return picture if width is None else resized(picture, width / picture.shape[1])


def beside(pictures: list[np.ndarray], height: int) -> np.ndarray:
    """Return pictures in a row, of one height, with white between them."""
    gap = np.full((height, GAP_PIXELS, 3), 255, np.uint8)
    row = []
    for picture in pictures:
        small = resized(picture, height / picture.shape[0])
        row += [small[:height], gap]
    return np.hstack(row[:-1])


def resized(picture: np.ndarray, factor: float) -> np.ndarray:
    """Return a picture of another size."""
    size = (max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def save(name: str, picture: np.ndarray) -> None:
    """Write a JPEG of at most MAX_BYTES, as good as that allows."""
    for quality in (90, 80, 70, 60, 50):
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        if len(data) <= MAX_BYTES:
            break
    assert len(data) <= MAX_BYTES, f"{name} has {len(data)} bytes"
    (IMAGES / name).write_bytes(data)


if __name__ == "__main__":
    main()
