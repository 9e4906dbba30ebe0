"""The Nav2 map against the boxes that really stand there, read by the rules of map_server.

Run: python benchmarks/nav2.py --csv FILE [--shard I/N] [--limit N] [--summary]. Ten drives of 60
frames of 640 x 480 around a loop of 6 m, with 5 to 10 boxes, of which every third one moves, over
five floors; and the same floors without a box. Each is mapped with the true calibration.

`outline` counts points of the standing boxes' outlines, 8 mm apart, that some frame saw: inside its
range, on a side that is turned towards the camera. `found` are those with an occupied cell within
5 cm. `wrong` counts free cells whose middle lies in a box. A moving box is no part of either. On an
empty floor every occupied cell is a speck.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import sweep
import yaml
from drives import Drive, make_drive
from numpy.typing import NDArray

from slamcli.core.camera.projection import project_floor
from slamcli.core.config import MapperOptions, ProductOptions
from slamcli.core.geometry import Grid, apply_homography
from slamcli.run.session.session import Session
from slamcli.run.stitch import stitch
from slamcli.run.stitch.options import StitchOptions
from slamcli.simulation.config import SimulationOptions

FLOORS = ("asphalt", "concrete", "carpet", "terrazzo", "parquet")
STEP_METRES, NEAR_METRES = 0.008, 0.05


@dataclass(frozen=True)
class Cell:
    """One drive."""

    floor: str
    boxes: int
    seed: int


def cells() -> list[Cell]:
    """Return ten drives with boxes, and five without."""
    found = [Cell(FLOORS[seed % 5], 5 + (seed * 7) % 6, seed) for seed in range(10)]
    return [*found, *(Cell(floor, 0, 10 + seed) for seed, floor in enumerate(FLOORS))]


def measure(cell: Cell) -> sweep.Row:
    """Return the counts of one drive."""
    options = SimulationOptions(floor=cell.floor, length_metres=6.0, frames=60, seed=cell.seed)
    options = replace(options, disturbances=replace(options.disturbances, boxes=cell.boxes))
    drive = make_drive(options)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "map"
        stitch(
            [drive.folder / "frames"],
            drive.folder / "camera.yaml",
            output,
            StitchOptions(MapperOptions(), products=ProductOptions(formats=("nav2",))),
            overwrite=True,
            session=Session(workers=1),
        )
        states, grid = read_map(output / "nav2.yaml")
    standing = boxes_of(drive.folder)
    rows, columns = np.nonzero(states == 0)
    free = apply_homography(grid.metres_from_pixel, np.column_stack([columns, rows]))
    inside = np.zeros(len(free), np.bool_)
    for box in standing:
        inside |= [
            cv2.pointPolygonTest(box, (x, y), measureDist=False) >= 0 for x, y in free.tolist()
        ]
    outline, found = recall(drive, standing, states, grid)
    occupied = int(np.count_nonzero(states == 100))
    known = len(free) + occupied
    return {
        "outline": outline,
        "found": found,
        "free": len(free),
        "wrong": int(np.count_nonzero(inside)),
        "occupied": occupied,
        "known_square_metres": round(known * grid.metres_per_pixel**2, 3),
    }


def read_map(path: Path) -> tuple[NDArray[np.int_], Grid]:
    """Read a map as Nav2's map_server does (trinary): -1 unknown, 0 free, 100 occupied."""
    described = yaml.safe_load(path.read_text())
    gray = cv2.imread(str(path.parent / described["image"]), cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    occupancy = (255 - gray.astype(float)) / 255
    states = np.full(gray.shape, -1)
    states[occupancy < described["free_thresh"]] = 0
    states[occupancy > described["occupied_thresh"]] = 100
    x, y, _ = described["origin"]
    scale = described["resolution"]
    return states, Grid(x, y + gray.shape[0] * scale, scale, gray.shape[1], gray.shape[0])


def boxes_of(folder: Path) -> list[NDArray[np.float32]]:
    """Return the corners of the boxes that stand still, counter-clockwise."""
    collection = json.loads((folder / "obstacles.geojson").read_text())
    return [
        np.array(feature["geometry"]["coordinates"][0][:-1], np.float32)
        for feature in collection["features"]
        if not any(value for key, value in feature["properties"].items() if "velocity" in key)
    ]


def recall(
    drive: Drive, boxes: list[NDArray[np.float32]], states: NDArray[np.int_], grid: Grid
) -> tuple[int, int]:
    """Return how many points of outlines some frame saw, and how many of those were found."""
    free_of = np.where(states == 100, np.uint8(0), np.uint8(1))
    distance = cv2.distanceTransform(free_of, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outline = found = 0
    for points, outward in (side for box in boxes for side in sides(box)):
        seen = np.zeros(len(points), np.bool_)
        for pose in drive.truth:
            turned = (np.array([pose.x, pose.y]) - points) @ outward > 0
            _, visible = project_floor(drive.calibration, pose.inverse().apply(points))
            seen |= turned & visible
        pixels = np.rint(apply_homography(grid.pixel_from_metres, points[seen])).astype(int)
        inside = np.all((pixels >= 0) & (pixels < (grid.width, grid.height)), axis=1)
        outline += int(np.count_nonzero(seen))
        columns, rows = pixels[inside].T
        near = distance[rows, columns] * grid.metres_per_pixel <= NEAR_METRES
        found += int(np.count_nonzero(near & (states == 100).any()))
    return outline, found


def sides(box: NDArray[np.float32]) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the points of each side of a box, and its outward direction."""
    for start, end in zip(box, np.roll(box, -1, axis=0), strict=True):
        along = (end - start).astype(np.float64)
        count = max(2, round(float(np.hypot(*along)) / STEP_METRES))
        yield start + np.linspace(0, 1, count)[:, None] * along, np.array([along[1], -along[0]])


def main() -> None:
    """Run the drives and print what they say."""
    parser = argparse.ArgumentParser(description=__doc__)
    sweep.add_arguments(parser)
    rows = sweep.run(cells(), measure, parser.parse_args())
    boxes = [row for row in rows if row["boxes"] != "0"]
    empty = [row for row in rows if row["boxes"] == "0"]
    total = sweep.total
    print(
        f"{len(boxes)} drives: found {sweep.share(total(boxes, 'found'), total(boxes, 'outline'))}"
    )
    print(f"free that is occupied: {sweep.share(total(boxes, 'wrong'), total(boxes, 'free'))}")
    print(f"{len(empty)} empty drives: {total(empty, 'occupied')} occupied cells")


if __name__ == "__main__":
    main()
