"""Cost of one 1080p frame, stage by stage, beside the OpenCV kernels that it consists of.

Run: python benchmarks/stages.py [--frames N] [--drive FOLDER] [--whole N] [--metres-per-pixel M].
Every figure is a median over the frames of one run on one thread; compare ratios, not milliseconds,
between machines.

With --whole N, `slam stitch` then maps N frames (a drive's own, forwards and backwards in turn) on
all processors, and its wall time is compared with that of its kernels alone, from the table:
OpenCV's where there is one, and for the pyramid and the photometric check and refinement the stage
itself.
"""

from __future__ import annotations

import argparse
import math
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scale import repeat

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import choose_max_range, default_metres_per_pixel
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.geometry import Pose2
from slamcli.core.records import PosedFrame, Tile
from slamcli.io.calibrations import load_calibration, save_calibration
from slamcli.io.files import write_image
from slamcli.io.frames import FrameFile, list_frames, read_frame
from slamcli.io.raster import png, world_file
from slamcli.mapping.mapper import Mapper
from slamcli.run.session.executor import default_workers
from slamcli.stages import align, dense, features, view
from slamcli.stages.mosaic import exposure
from slamcli.stages.mosaic.painter import Painter

IMAGE_SIZE = (1920, 1080)
STEP_METRES = 0.03


def make_calibration() -> Calibration:
    """Return a small robot's camera: 0.3 m up, looking 35 degrees down."""
    width, height = IMAGE_SIZE
    matrix = np.array([[1600.0, 0, (width - 1) / 2], [0, 1600.0, (height - 1) / 2], [0, 0, 1.0]])
    pitch = math.radians(35.0)
    robot_from_image = compose_robot_from_image(matrix, 0.3, pitch, 0.0)
    image_from_robot = np.linalg.inv(robot_from_image)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.zeros(5),
        distortion_model="plumb_bob",
        image_size=IMAGE_SIZE,
        robot_from_image=robot_from_image,
        height_metres=0.3,
        pitch_radians=pitch,
        roll_radians=0.0,
        max_range_metres=choose_max_range(matrix, image_from_robot, IMAGE_SIZE),
    )


def make_frames(calibration: Calibration, count: int, folder: Path) -> None:
    """Write pictures of one noise floor, the robot driving straight ahead."""
    generator = np.random.default_rng(0)
    side, floor_metres_per_pixel = 4096, 0.001
    floor = np.zeros((side, side), np.float32)
    for sigma, share in ((1.0, 1.0), (3.0, 1.5), (10.0, 1.0)):
        layer = generator.normal(size=floor.shape).astype(np.float32)
        layer = cv2.GaussianBlur(layer, (0, 0), sigma)
        floor += share * layer / layer.std()
    floor = np.clip(120 + 28 * floor / floor.std(), 0, 255).astype(np.uint8)
    floor_from_metres = np.diag([1 / floor_metres_per_pixel, 1 / floor_metres_per_pixel, 1.0])
    floor_from_metres[1, 2] = side / 2
    for index in range(count):
        map_from_robot = Pose2(STEP_METRES * index)
        floor_from_image = floor_from_metres @ map_from_robot.matrix @ calibration.robot_from_image
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        picture = cv2.warpPerspective(floor, floor_from_image, IMAGE_SIZE, flags=flags)
        noisy = picture + generator.normal(0.0, 3.0, picture.shape)
        gray = np.clip(noisy, 0, 255).astype(np.uint8)
        write_image(folder / f"{index:04d}.jpg", np.dstack([gray] * 3), jpeg_quality=90)


def median_milliseconds(work: Callable[[int], object], count: int) -> float:
    """Return the median of this thread's own time for work(0) .. work(count - 1)."""
    durations = []
    for index in range(count):
        started = time.thread_time()
        work(index)
        durations.append(time.thread_time() - started)
    return 1e3 * float(np.median(durations))


@dataclass(frozen=True)
class Row:
    """One stage's cost.

    Attributes
    ----------
    milliseconds, kernel_milliseconds : float
        Of one call; of its bare kernels, nan where it is one itself.
    a_frame : float
        Calls for a frame of a run.
    """

    stage: str
    milliseconds: float
    kernel_milliseconds: float
    a_frame: float = 1.0

    @property
    def kernel(self) -> float:
        """What its kernels take for a frame of a run, milliseconds."""
        bare = self.kernel_milliseconds
        return self.a_frame * (self.milliseconds if math.isnan(bare) else bare)


def measure(calibration: Calibration, files: list[FrameFile], scale: float) -> list[Row]:
    """Return each stage's cost, for a map of `scale` metres per pixel."""
    cv2.setNumThreads(1)
    count = len(files)
    data = [np.frombuffer(file.path.read_bytes(), np.uint8) for file in files]
    frames = [read_frame(file) for file in files]
    painter = Painter(calibration, scale)
    decode = median_milliseconds(lambda i: read_frame(files[i], halved=painter.halves), count)
    kind = cv2.IMREAD_REDUCED_COLOR_2 if painter.halves else cv2.IMREAD_COLOR
    bare_decode = median_milliseconds(lambda i: cv2.imdecode(data[i], kind), count)
    gray = median_milliseconds(lambda i: read_frame(files[i], gray=True), count)
    bare_gray = median_milliseconds(lambda i: cv2.imdecode(data[i], cv2.IMREAD_GRAYSCALE), count)

    mapper = Mapper(calibration)
    track = [mapper.update(frame).map_from_robot or Pose2() for frame in frames]
    tried = len(mapper.links) / count
    resampler = view.make_view_resampler(calibration, mapper.metres_per_pixel)
    grid = resampler.grid
    view_from_image = grid.pixel_from_metres @ calibration.robot_from_image
    grays = [view.to_gray(frame.image) for frame in frames]
    thumbnail = median_milliseconds(lambda i: exposure.thumbnail(grays[i]), count)
    views = [view.make_view(frame, resampler, gray=True) for frame in frames]
    warp = median_milliseconds(lambda i: view.make_view(frames[i], resampler, gray=True), count)
    size = (grid.width, grid.height)
    bare_warp = median_milliseconds(
        lambda i: cv2.warpPerspective(grays[i], view_from_image, size), count
    )

    options = mapper.options
    found = [features.extract(one, calibration, options.features) for one in views]
    detect = median_milliseconds(
        lambda i: features.extract(views[i], calibration, options.features), count
    )
    orb = cv2.ORB_create(options.features.count)
    bare_detect = median_milliseconds(
        lambda i: orb.detectAndCompute(views[i].image, resampler.mask), count
    )

    fits = [align.align(found[i], found[i + 1], options.matching) for i in range(count - 1)]
    fit = median_milliseconds(
        lambda i: align.align(found[i], found[i + 1], options.matching), count - 1
    )
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    bare_fit = median_milliseconds(lambda i: bare_match(matcher, found[i], found[i + 1]), count - 1)

    tilt = math.radians(options.tilt_sigma_degrees)
    poses = [fit.pose or Pose2(STEP_METRES) for fit in fits]
    level_masks = dense.make_level_masks(resampler.mask)
    make = median_milliseconds(lambda i: dense.make_levels(views[i], level_masks), count)
    levels = [dense.make_levels(one) for one in views]
    agree = median_milliseconds(
        lambda i: dense.agreement(levels[i][0], levels[i + 1][0], poses[i].matrix), count - 1
    )
    refine = median_milliseconds(
        lambda i: dense.refine(levels[i][:2], levels[i + 1][:2], poses[i], calibration, tilt),
        count - 1,
    )

    paint = median_milliseconds(lambda i: painter.patch(frames[i], track[i]), count)
    grids = [painter.extent([track[i]]) for i in range(count)]
    patch_size = (grids[0].width, grids[0].height)
    map_from_image = [
        grids[i].pixel_from_metres @ track[i].matrix @ calibration.robot_from_image
        for i in range(count)
    ]
    bare_paint = median_milliseconds(
        lambda i: cv2.warpPerspective(frames[i].image, map_from_image[i], patch_size), count
    )
    posed_frames = [PosedFrame(i, track[i], calibration) for i in range(count)]
    sources = [read_frame(file, halved=painter.halves) for file in files]
    pictures = [painter.picture(source, number) for number, source in enumerate(sources)]
    plan = painter.plan(posed_frames)

    def paint_tile(index: int) -> Tile | None:
        key, numbers = plan[index]
        return painter.paint(key, posed_frames, numbers, pictures.__getitem__)

    tiles = [paint_tile(index) for index in range(len(plan))]
    blend = median_milliseconds(paint_tile, len(plan)) * len(plan) / count
    picture = np.vstack([tile.image for tile in tiles if tile is not None])
    mask = np.full(picture.shape[:2], 255, np.uint8)
    pixels = world_file.transparent(picture, mask)
    encode = median_milliseconds(lambda _: png.compress(pixels), 3) / count
    bare_encode = median_milliseconds(lambda _: encode_png(pixels), 3) / count
    return [
        Row("decode JPEG in gray", gray, bare_gray),
        Row("thumbnail for the exposure", thumbnail, math.nan),
        Row("decode JPEG to paint", decode, bare_decode),
        Row("warp to the view", warp, bare_warp),
        Row("detect ORB", detect, bare_detect),
        Row("match and fit", fit, bare_fit, tried),
        Row("pyramid of the view", make, math.nan),
        Row("photometric check", agree, math.nan, tried),
        Row("photometric refinement", refine, math.nan, tried),
        Row("paint a patch", paint, bare_paint, 0.0),
        Row("paint the tiles (share)", blend, bare_paint),
        Row("encode PNG (share)", encode, bare_encode),
    ]


def bare_match(matcher: cv2.BFMatcher, a: features.Features, b: features.Features) -> object:
    """Match and fit a similarity by OpenCV alone."""
    pairs = matcher.knnMatch(b.descriptors, a.descriptors, k=2)
    good = [first for first, second in pairs if first.distance < 0.8 * second.distance]
    points_a = np.array([a.points[match.trainIdx] for match in good])
    points_b = np.array([b.points[match.queryIdx] for match in good])
    return cv2.estimateAffinePartial2D(points_b, points_a, ransacReprojThreshold=0.003)


def encode_png(picture: NDArray[np.uint8]) -> None:
    """Encode the whole map once, compressed as the map is."""
    up = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1, *up])


def whole(
    drive: Path, camera_file: Path, count: int, scale: float, work: Path
) -> tuple[float, float]:
    """Map `count` frames of a drive; return wall and processor seconds."""
    frames = work / "repeated"
    frames.mkdir()
    repeat(drive, count, frames)
    command = [sys.executable, "-m", "slamcli", "stitch", str(frames), "-c", str(camera_file)]
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command += ["--metres-per-pixel", str(scale), "-o", str(work / "map")]
    subprocess.run(command, check=True, capture_output=True)
    wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, used


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--drive", type=Path, help="of slam simulate; default: made here")
    parser.add_argument("--whole", type=int, default=0)
    parser.add_argument("--metres-per-pixel", type=float, help="of the map")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = drive = Path(name)
        calibration = make_calibration()
        if arguments.drive is not None:
            drive = arguments.drive
            calibration = load_calibration(drive / "camera.yaml")
        else:
            (drive / "frames").mkdir()
            make_frames(calibration, arguments.frames, drive / "frames")
            save_calibration(drive / "camera.yaml", calibration)
        scale = arguments.metres_per_pixel or default_metres_per_pixel(calibration)
        rows = measure(calibration, list_frames([drive / "frames"])[: arguments.frames], scale)
        print(
            f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, "
            f"OpenCV {cv2.__version__}, one thread, 1920x1080"
        )
        print(f"{'stage':<24}{'ms':>8}{'kernel':>9}{'ratio':>8}{'a frame':>9}")
        for row in rows:
            bare, ours = row.kernel_milliseconds, row.milliseconds
            bare_columns = f"{'':>17}" if math.isnan(bare) else f"{bare:9.1f}{ours / bare:8.2f}"
            print(f"{row.stage:<24}{ours:8.1f}{bare_columns}{row.a_frame:9.2f}")
        kernels = sum(row.kernel for row in rows)
        print(f"{'sum for a frame':<24}{sum(r.a_frame * r.milliseconds for r in rows):8.1f}")
        print(f"{'kernels for a frame':<24}{kernels:8.1f}")
        if arguments.whole:
            wall, used = whole(drive, drive / "camera.yaml", arguments.whole, scale, work)
            least = 1e-3 * kernels * arguments.whole / default_workers()
            print(
                f"{arguments.whole} frames: wall {wall:.1f} s, {wall / least:.2f} times the kernels"
                f" on {default_workers()} processors; processor {used:.1f} s, {used / wall:.0%} "
                "of one"
            )


if __name__ == "__main__":
    main()
