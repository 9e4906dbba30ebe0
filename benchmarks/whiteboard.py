"""A whiteboard photographed from all sides, without a calibration: in order, and shuffled.

Run: python benchmarks/whiteboard.py [--seed N]. Twelve photos of 800x600 in three rows, places off
by 60 pixels (one sigma), tilts of up to 23 degrees about both axes, heights that vary by 15 %,
uneven light and noise. Of each order: photos in the largest map, and the RMSE and median of their
corners' errors after one similarity onto the truth, pixels of a photo; at last those of the one map
onto the other.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from surveys import frame_corners, rmse

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import rocked
from slamcli.core.geometry import apply_homography, invert
from slamcli.io.map_file import load_map
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES, YAW, project

SIZE, FOCAL, BOARD_SIZE = (800, 600), 640.0, (3000, 2000)
PLACE_PIXELS, TILT_RADIANS, TURN_RADIANS, LOG_SCALE_SIGMA = 60.0, 0.4, 0.15, 0.15
LIGHT_SHARE, NOISE_GRAY = 0.08, 2.5


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=10)
    arguments = parser.parse_args()
    generator = np.random.default_rng(arguments.seed)
    states = photo_states(generator)
    photos = photographs(whiteboard(), states, generator)
    image_from_board = project(states, FOCAL).image_from_map
    truth = {
        number: apply_homography(invert(one), frame_corners(SIZE))
        for number, one in enumerate(image_from_board)
    }
    orders = {
        "in order": np.argsort(states[:, 0]),
        "shuffled": generator.permutation(len(photos)),
    }
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, order in orders.items():
            found[name] = map_corners(Path(scratch) / name, [photos[n] for n in order], order)
            scale = print_row(name, found[name], truth)
    # The scale of the map to pixels of the truth is that of the last map.
    used = {n: corners * scale for n, corners in found["shuffled"].items()}
    print_row("shuffled to in order", found["in order"], used)


def whiteboard() -> UInt8Array:
    """Return a board with words and strokes in four colours."""
    generator = np.random.default_rng(5)
    board = np.full((*BOARD_SIZE[::-1], 3), 235, np.uint8)
    colours = [(30, 30, 30), (160, 40, 30), (30, 40, 170), (40, 120, 30)]
    for number in range(60):
        place = generator.integers((100, 100), (2700, 1900))
        colour = colours[int(generator.integers(4))]
        width = int(generator.integers(3, 8))
        if number % 3:
            letters = generator.integers(97, 123, int(generator.integers(3, 10)))
            word = "".join(chr(letter) for letter in letters)
            size = float(generator.uniform(1.5, 3.0))
            origin = int(place[0]), int(place[1])
            cv2.putText(
                board, word, origin, cv2.FONT_HERSHEY_COMPLEX, size, colour, width, cv2.LINE_AA
            )
        else:
            stroke = np.cumsum(generator.normal(0.0, 60.0, (14, 2)), axis=0) + place
            cv2.polylines(board, [stroke.astype(np.int32)], False, colour, width, cv2.LINE_AA)  # noqa: FBT003
    return board


def photo_states(generator: np.random.Generator) -> Float64Array:
    """Return the states of photos whose middles are spread over the board."""
    x, y = np.meshgrid(np.linspace(600.0, 2400.0, 4), np.linspace(-1500.0, -500.0, 3))
    states = np.zeros((x.size, STATES))
    states[:, :2] = np.column_stack([x.ravel(), y.ravel()])
    states[:, :2] += generator.normal(0.0, PLACE_PIXELS, (x.size, 2))
    states[:, YAW] = generator.normal(0.0, TURN_RADIANS, x.size)
    states[:, LOG_SCALE] = generator.normal(0.0, LOG_SCALE_SIGMA, x.size)
    states[:, [PITCH, ROLL]] = generator.uniform(-TILT_RADIANS, TILT_RADIANS, (x.size, 2))
    return states


def photographs(
    board: UInt8Array, states: Float64Array, generator: np.random.Generator
) -> list[UInt8Array]:
    """Return the photos: uneven light, which is another one in each, and noise."""
    middle = np.array([[1.0, 0.0, (SIZE[0] - 1) / 2], [0.0, 1.0, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
    across, down = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    photos = []
    for number, one in enumerate(project(states, FOCAL).image_from_map):
        # Rows of the board's picture run down, the map's y up.
        homography = middle @ one @ np.diag([1.0, -1.0, 1.0])
        seen = cv2.warpPerspective(
            board, homography, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        light = 1.0 + LIGHT_SHARE * np.sin(across / 90 + number) * np.cos(down / 70 - number)
        noisy = seen * light[..., None] + generator.normal(0.0, NOISE_GRAY, seen.shape)
        photos.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return photos


def map_corners(
    folder: Path, photos: list[UInt8Array], numbers: np.ndarray
) -> dict[int, Float64Array]:
    """Stitch photos; return the (4, 2) corners in the largest map of each that is there."""
    frames = folder / "frames"
    frames.mkdir(parents=True)
    for place, photo in enumerate(photos):
        cv2.imwrite(str(frames / f"{place:03}.png"), photo)
    command = (sys.executable, "-m", "slamcli", "stitch", str(frames), "-o", str(folder / "map"))
    subprocess.run(command, check=False, capture_output=True)
    floor_map = load_map(folder / "map", for_locating=False)
    camera, corners = floor_map.calibration, {}
    for one in floor_map.estimates:
        if one.map_from_robot is not None and one.fragment == 0:
            own = camera if one.rocking is None else rocked(camera, one.rocking)
            pixels = frame_corners(SIZE) + (np.array(SIZE) - 1) / 2
            board = apply_homography(own.robot_from_image, undistort_points(own, pixels))
            corners[int(numbers[one.index])] = one.map_from_robot.apply(board)
    return corners


def print_row(name: str, found: dict[int, Float64Array], there: dict[int, Float64Array]) -> float:
    """Print a row; return the scale of the truth to the map."""
    both = sorted(set(found) & set(there))
    z, w = (np.concatenate([one[n] for n in both]) @ [1.0, 1.0j] for one in (found, there))
    z, w = z - z.mean(), w - w.mean()
    errors = np.abs(np.vdot(z, w) / np.vdot(z, z) * z - w)
    used = f"{len(both)}/{len(there)}"
    print(f"{name:<22} {used:>7} {rmse(z, w):>8.3f} {np.median(errors):>8.3f} px", flush=True)
    return float(np.linalg.norm(w) / np.linalg.norm(z))


if __name__ == "__main__":
    main()
