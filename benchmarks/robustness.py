"""Robustness: frames placed, placed falsely, and their error, over floors x disturbances.

Run: python benchmarks/robustness.py [--floors a,b] [--disturbances c,d] [--frames N] [--csv FILE]
[--shard I/N] [--limit N] [--summary] [--reasons]. Each cell drives a simulated camera around a
circle; the plain chain beside it gets the same bird's-eye views by the true homography: ORB, ratio
test, cv2.estimateAffinePartial2D. A frame is falsely placed when the motion that places it is over
5 cm or 2 degrees off the truth.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise, product
from pathlib import Path

import cv2
import numpy as np
import sweep
from numpy.typing import NDArray

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint, footprint_hull
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.io.frames import read_image
from slamcli.mapping.mapper import Mapper
from slamcli.simulation import drive, floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions

FALSE_METRES, FALSE_DEGREES = 0.05, 2.0
FLOOR_METRES_PER_PIXEL = 0.0005
FRAME_RATE_HERTZ = 10.0
RATIO = 0.75
MIN_INLIERS = 8
ORIGIN = Pose2()
QUIET = DisturbanceOptions()
# All around this circle the camera sees some of the lines and squares.
COURSE_START = Pose2(-0.3, -0.45, 0.0)


@dataclass(frozen=True)
class World:
    """A floor, a camera over it and the circle that it drives."""

    floor: str
    wear: float = 0.5
    radius_metres: float = 1.5
    step_metres: float = 0.07
    start: Pose2 = ORIGIN
    camera: CameraOptions = field(default_factory=CameraOptions)
    room_metres: float = 0.0
    free_heading: bool = False


COURSE = World("course", radius_metres=0.45, start=COURSE_START)
WORLDS = {
    "course": COURSE,
    "asphalt": World("asphalt"),
    "carpet": World("carpet"),
    "tiles": World("tiles"),
    "planks": World("planks"),
    "terrazzo": World("terrazzo"),
    "bare": World("bare"),
    # Worlds on which a plain ORB chain places almost nothing.
    "textureless-course": replace(COURSE, wear=0.0),
    "five-prints": World("planks", wear=0.0),
    "top-down-photograph": World(
        "appendix_a/field.jpg",
        radius_metres=0.8,
        step_metres=0.05,
        camera=CameraOptions(pitch_degrees=90.0, height_metres=0.4),
        free_heading=True,
    ),
    "low-camera": replace(
        COURSE,
        wear=0.0,
        camera=CameraOptions(pitch_degrees=12.0, height_metres=0.11),
        room_metres=4.0,
    ),
    # One print on all tiles; steps of up to 40 % of a tile are determined by the motion so far.
    "identical-tiles": World("tiles", wear=0.0, step_metres=0.03),
}
FLOORS = ("course", "asphalt", "carpet", "tiles", "planks", "terrazzo", "bare")


@dataclass(frozen=True)
class Disturbance:
    """Disturbances of a world's images, and the overlap of its frames."""

    options: DisturbanceOptions = QUIET
    jpeg_quality: int = 92
    overlap: float | None = None


DISTURBANCES = {
    "none": Disturbance(),
    "motion-blur": Disturbance(DisturbanceOptions(motion_blur=0.3)),
    "flicker": Disturbance(DisturbanceOptions(flicker=0.4)),
    "noise": Disturbance(DisturbanceOptions(noise_gray=10.0)),
    "legs": Disturbance(DisturbanceOptions(walkers=12)),
    "low-overlap": Disturbance(overlap=0.3),
    "rocking": Disturbance(DisturbanceOptions(rocking_degrees=0.5)),
    "jpeg": Disturbance(jpeg_quality=30),
}


@dataclass(frozen=True)
class Cell:
    """A world by its name, a disturbance, and the drive's frames and seed."""

    floor: str
    disturbance: str
    frames: int
    seed: int


@dataclass(frozen=True)
class Outcome:
    """Result of a drive, in shares of its frames, and RPE from frame to frame."""

    placed: float
    false: float
    rpe_millimetres: float
    worst_millimetres: float
    fragments: int


def step_for_overlap(world: World, calibration: Calibration, overlap: float) -> float:
    """Return the step, metres, after which two footprints share `overlap` of their area."""
    outline = footprint_hull(calibration).astype(np.float32)
    whole = cv2.contourArea(outline)
    for step in np.arange(0.02, 4.0, 0.01):
        moved = circle(world.radius_metres, float(step), 1)[1].apply(outline.astype(np.float64))
        shared, _ = cv2.intersectConvexConvex(outline, moved.astype(np.float32))
        if shared / whole <= overlap:
            return float(step)
    return 4.0


def circle(radius_metres: float, step_metres: float, count: int) -> list[Pose2]:
    """Return count + 1 poses on a circle to the left, from the origin on."""
    angles = np.arange(count + 1) * step_metres / radius_metres
    return [
        Pose2(radius_metres * math.sin(a), radius_metres * (1.0 - math.cos(a)), float(a))
        for a in angles
    ]


def take_frames(
    world: World, disturbance: Disturbance, count: int, seed: int
) -> tuple[Calibration, list[Pose2], list[NDArray[np.uint8]]]:
    """Return the camera, true poses and frames of a drive."""
    calibration = photograph.make_camera(world.camera)
    step = world.step_metres
    if disturbance.overlap is not None:
        step = step_for_overlap(world, calibration, disturbance.overlap)
    poses = circle(world.radius_metres, step, count)
    if world.free_heading:
        swing = np.sin(np.arange(count + 1) * 0.4)
        poses = [Pose2(p.x, p.y, float(0.8 * s)) for p, s in zip(poses, swing, strict=True)]
    poses = [world.start @ pose for pose in poses]
    generator = np.random.default_rng([seed, 1])
    walkers = disturbance.options.walkers
    legs = drive.send_walkers(poses[:-1], walkers, FRAME_RATE_HERTZ, generator)
    room = None
    if world.room_metres:
        wall = floors.make_wall(FloorOptions(wear=world.wear), 0.002, seed)
        room = photograph.Room((0.0, 0.0), world.room_metres, wall)
    scene = photograph.World(make_floor(world, seed), legs, room=room)
    photographer = photograph.Photographer(scene, calibration)
    frames = []
    for index in range(count):
        image = photograph.take(
            photographer,
            (poses[index], poses[index + 1]),
            index / FRAME_RATE_HERTZ,
            disturbance.options,
            np.random.default_rng([seed, 2, index]),
        )
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, disturbance.jpeg_quality])
        frames.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8))
    return calibration, poses[:count], frames


def make_floor(world: World, seed: int) -> floors.Floor:
    """Return a world's floor; a picture is read from the folder in SLAMCLI_DATA."""
    if world.floor in floors.FLOORS:
        return floors.make_floor(
            world.floor, FloorOptions(wear=world.wear), FLOOR_METRES_PER_PIXEL, seed
        )
    picture = read_image(Path(os.environ["SLAMCLI_DATA"]) / world.floor)
    return floors.picture_floor(picture, 2 * FLOOR_METRES_PER_PIXEL)


def run_slam(
    calibration: Calibration, truth: list[Pose2], frames: list[NDArray[np.uint8]]
) -> tuple[Outcome, list[str]]:
    """Map the frames; return the result, and remarks on single frames."""
    mapper = Mapper(calibration)
    for index, image in enumerate(frames):
        mapper.update(Frame(index, f"{index:04d}", index / FRAME_RATE_HERTZ, image))
    estimates = mapper.finish()
    placed = [e for e in estimates if e.map_from_robot is not None]
    false, lines = set(), []
    for link in mapper.links:
        error = (truth[link.a].inverse() @ truth[link.b]).inverse() @ link.a_from_b
        if is_false(error):
            false.add(link.b)
            lines.append(f"{link.b:04d} false: {describe(error)}, score {link.score:.3f}")
    lines += [f"{e.index:04d} {e.reason}" for e in estimates if e.status == "lost"]
    errors = []
    for before, after in pairwise(placed):
        if after.index == before.index + 1 and after.fragment == before.fragment:
            assert before.map_from_robot is not None
            assert after.map_from_robot is not None
            moved = before.map_from_robot.inverse() @ after.map_from_robot
            true = truth[before.index].inverse() @ truth[after.index]
            errors.append((true.inverse() @ moved).translation_length)
    fragments = len({e.fragment for e in placed})
    return outcome(len(frames), len(placed), len(false), errors, fragments), lines


def run_plain(
    calibration: Calibration, truth: list[Pose2], frames: list[NDArray[np.uint8]]
) -> Outcome:
    """Return the result of the plain chain on a drive."""
    placed, false, errors = 1, 0, []
    for motion, (before, now) in zip(
        plain_motions(calibration, frames), pairwise(truth), strict=True
    ):
        if motion is not None:
            error = (before.inverse() @ now).inverse() @ motion
            placed += 1
            false += is_false(error)
            errors.append(error.translation_length)
    return outcome(len(frames), placed, false, errors, 1)


def plain_motions(
    calibration: Calibration, frames: Iterable[NDArray[np.uint8]]
) -> Iterator[Pose2 | None]:
    """Yield each frame's motion from the one before, or None, from the second frame on.

    By ORB, ratio test and a partial affine, on the true homography's bird's-eye views.
    """
    grid = footprint(calibration, Mapper(calibration).metres_per_pixel)
    pixel_from_image = grid.pixel_from_metres @ calibration.robot_from_image
    orb = cv2.ORB_create(2000)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    before = None
    for image in frames:
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        view = cv2.warpPerspective(gray, pixel_from_image, (grid.width, grid.height))
        now = orb.detectAndCompute(view, None)
        if before is not None:
            motion = fit_partial_affine(matcher, before, now)
            if motion is None:
                yield None
            else:
                yield pose_of(grid.metres_from_pixel @ motion @ grid.pixel_from_metres)
        before = now


def fit_partial_affine(
    matcher: cv2.BFMatcher, before: tuple, now: tuple
) -> NDArray[np.float64] | None:
    """Return before_from_now (3, 3), pixels, or None."""
    if before[1] is None or now[1] is None or len(before[0]) < 2:
        return None
    pairs = matcher.knnMatch(now[1], before[1], k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < RATIO * p[1].distance]
    if len(good) < MIN_INLIERS:
        return None
    source = np.float32([now[0][m.queryIdx].pt for m in good])
    target = np.float32([before[0][m.trainIdx].pt for m in good])
    matrix, inliers = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=3.0)
    if matrix is None or inliers.sum() < MIN_INLIERS:
        return None
    return np.vstack([matrix, [0.0, 0.0, 1.0]])


def pose_of(matrix: NDArray[np.float64]) -> Pose2:
    """Return the pose of a similarity, its scale left out."""
    return Pose2(matrix[0, 2], matrix[1, 2], math.atan2(matrix[1, 0], matrix[0, 0]))


def is_false(error: Pose2) -> bool:
    """Return whether a motion is so wrong that accepting it was false."""
    return error.translation_length > FALSE_METRES or abs(math.degrees(error.theta)) > FALSE_DEGREES


def describe(error: Pose2) -> str:
    """Return an error in words."""
    return f"{1e3 * error.translation_length:.1f} mm, {math.degrees(error.theta):.2f} degrees"


def outcome(
    count: int, placed: int, false: int, errors_metres: list[float], fragments: int
) -> Outcome:
    """Return shares and millimetres."""
    rms = float(np.sqrt(np.mean(np.square(errors_metres)))) if errors_metres else math.nan
    worst = max(errors_metres, default=math.nan)
    return Outcome(placed / count, false / count, 1e3 * rms, 1e3 * worst, fragments)


def run_cell(cell: Cell, *, reasons: bool) -> sweep.Row:
    """Run one cell of the table; print its false and lost frames where that is wanted."""
    drive_of = take_frames(
        WORLDS[cell.floor], DISTURBANCES[cell.disturbance], cell.frames, cell.seed
    )
    ours, lines = run_slam(*drive_of)
    if reasons:
        print("\n".join(lines), flush=True)
    plain = {f"plain_{name}": value for name, value in asdict(run_plain(*drive_of)).items()}
    return asdict(ours) | plain


def print_table(rows: list[dict[str, str]]) -> None:
    """Print the rows, ours / plain ORB."""
    print(
        "| floor | disturbance | placed | false | RPE mm (worst) | fragments "
        "| plain: placed | false | RPE mm |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        ours, plain = (
            [float(row[f"{prefix}{field_of.name}"]) for field_of in fields(Outcome)]
            for prefix in ("", "plain_")
        )
        print(
            f"| {row['floor']} | {row['disturbance']} | {ours[0]:.0%} | {ours[1]:.0%} "
            f"| {ours[2]:.2f} ({ours[3]:.1f}) | {ours[4]:.0f} "
            f"| {plain[0]:.0%} | {plain[1]:.0%} | {plain[2]:.2f} |"
        )


def main() -> None:
    """Run the cells that the file does not have yet, and print the table of all of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    sweep.add_arguments(parser)
    parser.add_argument("--floors", default=",".join(FLOORS), help=", ".join(WORLDS))
    parser.add_argument("--disturbances", default=",".join(DISTURBANCES))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    kinds = product(arguments.floors.split(","), arguments.disturbances.split(","))
    cells = [Cell(*kind, arguments.frames, arguments.seed) for kind in kinds]
    print_table(sweep.run(cells, lambda cell: run_cell(cell, reasons=arguments.reasons), arguments))


if __name__ == "__main__":
    main()
