"""Accuracy of `slam calibrate` for any mount: lengths on the floor over the whole view.

Run: python benchmarks/calibration_mounts.py [--rows FILE] [--only WORD]. One photo is simulated in
linear light for each mount (straight down, 2 degrees off in four directions, upside down, on its
side), target (square, chessboard, marker) and knowledge of the lens (`--intrinsics`, or nothing):
42 cells. The camera is 0.45 m above the floor; where its lens is given, or a chessboard is there to
show it, it distorts (k1 -0.12, k2 0.03); the board then fills most of the view. Each cell is a line
of FILE, appended as it is done: a run that was cut off goes on. In the last columns: the largest
error, in per cent, of a distance between floor points of the view that lie apart, as far as a
calibration keeps it, and what it may be.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import cv2
import numpy as np
from calibration_targets import (
    DICTIONARY,
    TARGETS,
    Photo,
    distance_ratios,
    render,
    true_points,
)

from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.errors import SlamcliError

# Pitch and roll about the optical axis, degrees; portrait or not.
MOUNTS = {
    "straight down": (90.0, 0.0, False),
    "2 degrees ahead": (88.0, 0.0, False),
    "2 degrees back": (88.0, 180.0, False),
    "2 degrees left": (88.0, 90.0, False),
    "2 degrees right": (88.0, -90.0, False),
    "upside down": (40.0, 180.0, False),
    "on its side": (40.0, 90.0, True),
}
HEIGHT, SIDE = 0.45, 0.24
# A board that is to show the lens fills most of the view.
BOARD, BOARD_SIDE, BOARD_TURN_DEGREES, TURN_DEGREES = (12, 9), 0.45, 5.0, 20.0
LIMIT_PERCENT, LIMIT_SQUARE_PERCENT = 0.5, 1.0


def photo_of(mount: str, target: str, *, known: bool) -> Photo:
    """Return the photo of a cell: the target near the middle of the view, turned a little."""
    pitch, roll, portrait = MOUNTS[mount]
    size = [480, 640] if portrait else [640, 480]
    across = (
        62.0 if not portrait else math.degrees(2 * math.atan(0.75 * math.tan(math.radians(31))))
    )
    board = target == "chessboard"
    distorted = known or board
    ahead = HEIGHT / math.tan(math.radians(pitch)) if pitch < 89 else 0.0
    return Photo(
        camera={
            "height_metres": HEIGHT,
            "pitch_degrees": pitch,
            "roll_degrees": roll,
            "field_of_view_degrees": across,
            "size": size,
            "k1": -0.12 if distorted else 0.0,
            "k2": 0.03 if distorted else 0.0,
        },
        imaging={"lens_blur_pixels": 0.7, "bayer": False, "sharpening": 0.0},
        noise_gray=2.0,
        floor_share=0.25,
        white=True,
        side_metres=BOARD_SIDE if board else SIDE,
        board=BOARD,
        place=[
            ahead + 0.01,
            -0.01,
            math.radians(BOARD_TURN_DEGREES if board else TURN_DEGREES),
        ],
    )


def calibrated(
    image: np.ndarray, target: str, photo: Photo, true: Calibration, *, known: bool
) -> Calibration:
    """Return the calibration from a photo."""
    from slamcli.run.calibrate import CalibrateOptions, find_target
    from slamcli.stages import calibrate as solving

    _, side = true_points(target, photo)
    kind = {"chessboard": {"chessboard": BOARD}, "aruco": {"marker": DICTIONARY}}.get(target, {})
    options = CalibrateOptions(side, **kind)  # type: ignore[arg-type]
    given = (true.camera_matrix, true.distortion, true.distortion_model, true.image_size)
    intrinsics = Intrinsics(*given) if known else None
    points = find_target(image, options, intrinsics).points
    if intrinsics is None:
        mounting = solving.solve_mounting(points, true.image_size)
    else:
        mounting = solving.solve_mounting_with_intrinsics(points, intrinsics)
    return solving.make_calibration(mounting, true.image_size, intrinsics, None)


def run_cell(mount: str, target: str, *, known: bool) -> dict[str, object]:
    """Return the row of a cell."""
    started = time.process_time()
    photo = photo_of(mount, target, known=known)
    image, true = render(target, photo, 7)
    only_square = target != "chessboard" and not known
    row: dict[str, object] = {
        "mount": mount,
        "target": target,
        "lens": "given" if known else "unknown",
        "limit_percent": LIMIT_SQUARE_PERCENT if only_square else LIMIT_PERCENT,
    }
    try:
        found = calibrated(image, target, photo, true, known=known)
        ratios = distance_ratios(true, found)
        row["percent"] = 100 * float(np.abs(ratios).max())
        row["median_percent"] = 100 * float(np.median(ratios))
        row["focal_percent"] = 100 * (found.camera_matrix[0, 0] / true.camera_matrix[0, 0] - 1)
    except SlamcliError as error:
        row["reason"] = str(error)
    return {**row, "seconds": time.process_time() - started}


def line(row: dict[str, object]) -> str:
    """Return a row as text."""
    numbers = [row.get(key) for key in ("focal_percent", "median_percent", "percent")]
    cells = [f"{number:>9.3f}" if isinstance(number, float) else f"{'-':>9}" for number in numbers]
    return (
        f"{row['mount']:<16}{row['target']:<12}{row['lens']:<9}{''.join(cells)}"
        f"{row['limit_percent']:>7}  {row.get('reason', '')}"
    )


def main() -> None:
    """Run the cells that are not done yet, and print all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    done: dict[tuple[object, ...], dict[str, object]] = {}
    if options.rows is not None and options.rows.exists():
        for text in options.rows.read_text().splitlines():
            row = json.loads(text)
            done[row["mount"], row["target"], row["lens"]] = row
    print(
        f"{'mount':<16}{'target':<12}{'lens':<9}{'focal %':>9}{'median %':>9}{'worst %':>9}  limit"
    )
    rows = []
    for mount in MOUNTS:
        for target in TARGETS:
            for lens in ("given", "unknown"):
                if options.only not in f"{mount} {target} {lens}":
                    continue
                row = done.get((mount, target, lens))
                if row is None:
                    row = run_cell(mount, target, known=lens == "given")
                    if options.rows is not None:
                        with options.rows.open("a") as file:
                            file.write(json.dumps(row) + "\n")
                rows.append(row)
                print(line(row), flush=True)
    right = sum(float(row.get("percent", math.inf)) <= float(row["limit_percent"]) for row in rows)  # type: ignore[arg-type]
    print(f"{right} of {len(rows)} within their limits")


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
