"""Accuracy of `slam calibrate` by photos in light: squares, chessboards, markers.

Run: python benchmarks/calibration_targets.py [--count N] [--gamma G] [--render FOLDER]
[--measure FOLDER] [--json FILE]. Twenty photos of each target are simulated in linear light, by
cameras 0.1 to 0.6 m above the floor that look down by 15 to 60 degrees through lenses of 0.7 to 1.5
picture widths, and calibrated from. White squares on dark floors and dark ones on light floors
take turns; half of the cameras have a colour filter, two thirds noise, half sharpen. --render
only writes the photos and their truth, --measure only reads them.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.lens import distort_points, undistort_points
from slamcli.core.errors import SlamcliError
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.io.calibrations import load_calibration, save_calibration

TARGETS = ("square", "chessboard", "aruco")
DICTIONARY, NUMBER = "4x4_50", 7
BOARD = (8, 6)
WHITE_GRAY, BLACK_GRAY = 232.0, 30.0
MARGIN_PIXELS, MIN_AREA_SHARE = 10.0, 0.03
# Smaller prints have fields of few pixels, which no one prints.
MIN_PRINT_AREA_SHARE = 0.08


@dataclass(frozen=True)
class Photo:
    """What is drawn at random: one camera, its imaging and the target before it."""

    camera: dict[str, float | list[int]]
    imaging: dict[str, float]
    noise_gray: float
    floor_share: float
    white: bool
    side_metres: float
    place: list[float]
    board: tuple[int, int] = BOARD


@dataclass(frozen=True)
class Outcome:
    """Errors of one photo's calibration."""

    name: str
    what: str
    corner_pixels: list[float]
    corner_nees: float
    height_share: float
    scale_share: float
    worst_scale_share: float
    sigmas: list[float]


def draw(target: str, index: int) -> Photo:
    """Return a photo in which the target is seen whole and large enough."""
    from slamcli.simulation.photograph import make_camera

    generator = np.random.default_rng([TARGETS.index(target), index])
    least = MIN_AREA_SHARE if target == "square" else MIN_PRINT_AREA_SHARE
    while True:
        size = [(640, 480), (1280, 720)][index % 2]
        camera = {
            "height_metres": float(generator.uniform(0.1, 0.6)),
            "pitch_degrees": float(generator.uniform(15.0, 60.0)),
            "roll_degrees": float(generator.uniform(-3.0, 3.0)),
            "field_of_view_degrees": math.degrees(2 * math.atan(0.5 / generator.uniform(0.7, 1.5))),
            "size": list(size),
        }
        calibration = make_camera(_camera_options(camera))
        height, pitch = calibration.height_metres, calibration.pitch_radians
        ahead = height / math.tan(pitch) * generator.uniform(0.6, 1.5)
        side = float(generator.choice([0.05, 0.1, 0.2, 0.3048]))
        place = [ahead, ahead * generator.uniform(-0.3, 0.3), generator.uniform(-0.8, 0.8)]
        corners = _outline(side, place)
        depth = corners @ calibration.image_from_robot[2, :2] + calibration.image_from_robot[2, 2]
        if depth.min() <= 0:
            continue
        pixels = apply_homography(calibration.image_from_robot, corners)
        inside = np.all((pixels > MARGIN_PIXELS) & (pixels < np.array(size) - 1 - MARGIN_PIXELS))
        area = cv2.contourArea(pixels.astype(np.float32)) / (size[0] * size[1])
        if inside and area > least:
            break
    white = index % 4 < 2
    return Photo(
        camera=camera,
        imaging={
            "lens_blur_pixels": float(generator.uniform(0.4, 1.2)),
            "bayer": bool(index // 2 % 2 ^ index // 5 % 2),
            "sharpening": float(generator.choice([0.0, 0.0, 0.3, 0.6])),
        },
        noise_gray=0.0 if index % 3 == 2 else 2.0,
        floor_share=0.25 if white or target != "square" else 1.4,
        white=white,
        side_metres=side,
        place=[float(number) for number in place],
    )


def render(target: str, photo: Photo, seed: int) -> tuple[np.ndarray, Calibration]:
    """Return the (H, W, 3) uint8 photograph and the true camera."""
    from slamcli.simulation import floors
    from slamcli.simulation.config import DisturbanceOptions, FloorOptions, ImagingOptions
    from slamcli.simulation.photograph import (
        Photographer,
        World,
        make_camera,
        take,
        texture_metres_per_pixel,
    )

    calibration = make_camera(_camera_options(photo.camera))
    floor = floors.make_floor(
        "concrete", FloorOptions(), texture_metres_per_pixel(calibration), seed, in_light=True
    )
    world = World(_Dimmed(floor, photo.floor_share), decals=tuple(_decals(target, photo)))
    photographer = Photographer(world, calibration, ImagingOptions(**photo.imaging))  # type: ignore[arg-type]
    disturbances = DisturbanceOptions(noise_gray=photo.noise_gray)
    generator = np.random.default_rng([seed, 1])
    return take(photographer, (Pose2(), Pose2()), 0.0, disturbances, generator), calibration


def true_points(target: str, photo: Photo) -> tuple[np.ndarray, float]:
    """Return the (N, 2) floor points that calibrate, metres, and the length that --side takes."""
    if target == "chessboard":
        columns, rows = photo.board
        field = photo.side_metres / (columns + 3)
        column, row = np.meshgrid(np.arange(columns), np.arange(rows))
        grid = np.column_stack([column.ravel() - (columns - 1) / 2, (rows - 1) / 2 - row.ravel()])
        return Pose2(*photo.place).apply(field * grid), field
    side = photo.side_metres * (0.75 if target == "aruco" else 1.0)
    return _outline(side, photo.place), side


def measure(
    target: str, name: str, image: np.ndarray, photo: Photo, true: Calibration, gamma: str
) -> Outcome:
    """Return the errors of the calibration from one photo."""
    from slamcli.run.calibrate import CalibrateOptions, find_target
    from slamcli.stages import calibrate as solving

    floor, side = true_points(target, photo)
    kind = {"chessboard": {"chessboard": BOARD}, "aruco": {"marker": DICTIONARY}}.get(target, {})
    options = CalibrateOptions(side, gamma=gamma, **kind)  # type: ignore[arg-type]
    found = find_target(image, options, None)
    size = true.image_size
    mounting = solving.solve_mounting(found.points, size)
    calibration = solving.make_calibration(mounting, size, None, None)
    pixels = apply_homography(true.image_from_robot, floor)
    error = _matched(found.points.pixels, pixels)
    nees = float(error.ravel() @ np.linalg.solve(found.points.covariance, error.ravel()))
    ratio = distance_ratios(true, calibration)
    numbers = [
        (mounting.focal_pixels, float(true.camera_matrix[0, 0])),
        (mounting.height_metres, true.height_metres),
        (mounting.pitch_radians, true.pitch_radians),
        (mounting.roll_radians, true.roll_radians),
    ]
    return Outcome(
        name=name,
        what=" ".join(
            ["white" if photo.white else "dark", f"blur {photo.imaging['lens_blur_pixels']:.1f}"]
            + [word for word in ("bayer", "sharpening") if photo.imaging[word]]
            + (["noise"] if photo.noise_gray else [])
        ),
        corner_pixels=[float(e) for e in np.linalg.norm(error, axis=1)],
        corner_nees=nees / error.size,
        height_share=mounting.height_metres / true.height_metres - 1.0,
        scale_share=float(np.median(ratio)),
        worst_scale_share=float(np.abs(ratio).max()),
        sigmas=[float((a - b) / s) for (a, b), s in zip(numbers, mounting.sigmas, strict=True)],
    )


def distance_ratios(true: Calibration, found: Calibration) -> np.ndarray:
    """Return by which shares distances between points of the floor in view come out too long."""
    points = seen_floor(true)
    points = points[:: max(1, len(points) // 200)]
    pixels = distort_points(true, apply_homography(true.image_from_robot, points))
    measured = apply_homography(found.robot_from_image, undistort_points(found, pixels))
    first, second = np.triu_indices(len(points), 1)
    length = np.linalg.norm(points[first] - points[second], axis=1)
    apart = length > 0.3 * length.max()
    other = np.linalg.norm(measured[first] - measured[second], axis=1)
    return other[apart] / length[apart] - 1.0


def _matched(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return (N, 2) errors, for the order of the true points that fits best."""
    orders = [true, true[::-1]]
    if len(true) == 4:
        orders = [np.roll(turned, k, axis=0) for turned in orders for k in range(4)]
    errors = [found - order for order in orders]
    return min(errors, key=lambda error: float(np.abs(error).max()))


def _outline(side: float, place: list[float]) -> np.ndarray:
    """Return (4, 2) corners of a square in the robot frame, counter-clockwise."""
    half = side / 2
    return Pose2(*place).apply(half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]]))


def _decals(target: str, photo: Photo) -> list[object]:
    from slamcli.simulation.photograph import Decal

    place = Pose2(*photo.place)
    if target == "square":
        gray = WHITE_GRAY if photo.white else BLACK_GRAY
        return [Decal(_outline(photo.side_metres, photo.place), gray)]
    decals = [Decal(_outline(photo.side_metres, photo.place), WHITE_GRAY)]
    if target == "chessboard":
        columns, rows = photo.board
        field = photo.side_metres / (columns + 3)
        cells = [
            (column + 1 - columns / 2, row + 1 - rows / 2, BLACK_GRAY)
            for row in range(-1, rows)
            for column in range(-1, columns)
            if (row + column) % 2 == 0
        ]
    else:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        bits = np.asarray(cv2.aruco.generateImageMarker(dictionary, NUMBER, 6))
        field = photo.side_metres * 0.75 / 6
        decals.append(Decal(_outline(6 * field, photo.place), BLACK_GRAY))
        cells = [
            (column - 2.5, 2.5 - row, WHITE_GRAY)
            for row in range(6)
            for column in range(6)
            if bits[row, column]
        ]
    square = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    for x, y, gray in cells:
        decals.append(Decal(place.apply(field * (square + np.array([x, y]))), gray))
    return decals


class _Dimmed:
    """A floor whose light is multiplied."""

    in_light = True

    def __init__(self, floor: object, share: float) -> None:
        self.metres_per_pixel = floor.metres_per_pixel  # type: ignore[attr-defined]
        self._floor, self._share = floor, share

    def region(self, grid: object) -> np.ndarray:
        light = self._floor.region(grid) * np.float32(self._share)  # type: ignore[attr-defined]
        return np.minimum(light, 65535).astype(np.uint16)


def _camera_options(camera: dict[str, float | list[int]]) -> object:
    from slamcli.simulation.config import CameraOptions

    return CameraOptions(**{**camera, "size": tuple(camera["size"])})  # type: ignore[arg-type]


def write_photos(folder: Path, count: int) -> None:
    """Render all photos, with the truth beside each."""
    folder.mkdir(parents=True, exist_ok=True)
    for target in reversed(TARGETS):
        for index in range(count):
            photo = draw(target, index)
            image, calibration = render(target, photo, index)
            stem = folder / f"{target}_{index:02d}"
            cv2.imwrite(f"{stem}.png", image)
            save_calibration(Path(f"{stem}.yaml"), calibration)
            Path(f"{stem}.json").write_text(json.dumps(photo.__dict__))


def measure_photos(folder: Path, gamma: str) -> tuple[list[Outcome], list[str]]:
    """Calibrate from each photo; return the errors, and the lines of those that failed."""
    outcomes, failures = [], []
    for path in sorted(folder.glob("*.json")):
        photo = Photo(**json.loads(path.read_text()))
        image = np.asarray(cv2.imread(str(path.with_suffix(".png"))), dtype=np.uint8)
        true = load_calibration(path.with_suffix(".yaml"))
        target = path.stem.split("_")[0]
        try:
            outcomes.append(measure(target, path.stem, image, photo, true, gamma))
        except SlamcliError as error:
            failures.append(f"{path.stem}: {error}")
    return outcomes, failures


def table(outcomes: list[Outcome]) -> list[str]:
    """Return a line a photo, and medians and worst a kind of target."""
    lines = [
        f"{'photo':<15}{'':<36}{'corner px':>10}{'worst':>7}{'NEES':>7}{'height %':>10}"
        f"{'scale %':>9}{'pairs %':>9}  sigmas (f, h, pitch, roll)"
    ]
    lines += [
        f"{o.name:<15}{o.what:<36}{np.median(o.corner_pixels):>10.3f}{max(o.corner_pixels):>7.3f}"
        f"{o.corner_nees:>7.2f}{100 * o.height_share:>10.3f}{100 * o.scale_share:>9.3f}"
        f"{100 * o.worst_scale_share:>9.3f}  " + " ".join(f"{s:5.1f}" for s in o.sigmas)
        for o in outcomes
    ]
    for target in TARGETS:
        own = [o for o in outcomes if o.name.startswith(target)]
        if not own:
            continue
        corners = np.concatenate([o.corner_pixels for o in own])
        height = 100 * np.abs([o.height_share for o in own])
        scale = 100 * np.abs([o.scale_share for o in own])
        z = np.sqrt(np.mean(np.square([o.sigmas for o in own]), axis=0))
        lines.append(
            f"{target:<11}{len(own):>3} photos: corners {np.median(corners):.3f} px median, "
            f"{corners.max():.3f} worst; height {np.median(height):.3f} % median, "
            f"{height.max():.3f} worst; scale {np.median(scale):.3f} % median, {scale.max():.3f} "
            f"worst; NEES {np.mean([o.corner_nees for o in own]):.2f}; "
            f"errors in sigmas (f, h, pitch, roll) {' '.join(f'{s:.2f}' for s in z)}"
        )
    return lines


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--gamma", default="srgb")
    parser.add_argument("--render", type=Path)
    parser.add_argument("--measure", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.measure or options.render or Path(temporary)
        if options.measure is None:
            write_photos(folder, options.count)
        if options.render is not None:
            return
        outcomes, failures = measure_photos(folder, options.gamma)
    print("\n".join([*table(outcomes), *failures]))
    if options.json is not None:
        options.json.write_text(json.dumps([o.__dict__ for o in outcomes], indent=1))


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
