"""`slam calibrate`: a camera calibration from photos of a square on the floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Intrinsics
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.lens import Lens, image_centre, undistort_points
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.config import FeatureOptions
from slamcli.core.errors import CalibrationError, FrameError, InputError, SlamcliError
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.light import Gamma
from slamcli.core.records import Frame
from slamcli.drawing.calibration import birdseye_grid, draw_calibration
from slamcli.io.calibrations import CalibrationSource, load_intrinsics, save_calibration
from slamcli.io.files import write_drawing
from slamcli.io.frames import read_image
from slamcli.io.images.photo import read_photo_info
from slamcli.io.outputs import refuse_existing
from slamcli.io.runs import camera_section
from slamcli.run.calibrate.mountings import (
    Result,
    Target,
    choose_best,
    compare,
    corner_text,
    describe,
    floor_areas,
)
from slamcli.run.command_report import Report
from slamcli.stages import calibrate as solving
from slamcli.stages import features, square, view
from slamcli.stages.calibrate import board

# Error of a given corner, one sigma, where nothing measured it.
_GIVEN_CORNER_SIGMA_PIXELS = 0.5
# Corners moved farther to the picture's edges are reported: three sigmas. At the near edge of a low
# camera's square two pixels are one or two per cent of the map's scale.
_MAX_CORNER_ERROR_PIXELS = 1.5
# Of a focal length noted in whole millimetres of 35 mm film, as a share: rounding, focus, crop.
_NOTED_FOCAL_SIGMA = 0.05
# Error of corners by an unknown lens and an uneven floor, as a share of the picture's width
# [guarded by tests/stages/test_square.py].
_TOLERANCE_SHARE = 0.004
# Sides that bend by more than this share of their length, and by half a pixel, are reported.
_MAX_BOW_SHARE = 0.002
_MAX_BOW_PIXELS = 0.5
_COMPARED_FEATURES = 20_000
_YAML_SUFFIXES = {".yaml", ".yml"}

Ahead = Literal["up", "right", "down", "left"]
AHEAD_RADIANS: dict[Ahead, float] = {
    "up": 0.0,
    "right": math.pi / 2,
    "down": math.pi,
    "left": -math.pi / 2,
}


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """The options of `slam calibrate`.

    Attributes
    ----------
    side_metres : float
        Of the square, the marker, or one field of the chessboard.
    corners : tuple of (x, y) pairs or None
        Pixels; any order.
    refine : bool or None
        Move the given corners to the picture's edges nearby; None where they are found.
    chessboard : (float, float) or None
        Inner corners along both sides; whole numbers.
    marker : str or None
        ArUco dictionary.
    intrinsics_path : Path or None
        ROS camera_info.
    max_range_metres : float or None
        Far limit; chosen by the sampling when None.
    gamma : Gamma
        How the photos' values encode light.
    ahead : Ahead or None
        Direction in the picture that points ahead; None for the optical axis, or the picture's up
        where the camera looks about straight down.
    """

    side_metres: float
    corners: tuple[tuple[float, float], ...] | None = None
    refine: bool | None = None
    chessboard: tuple[float, float] | None = None
    marker: str | None = None
    intrinsics_path: Path | None = None
    max_range_metres: float | None = None
    gamma: Gamma = "srgb"
    ahead: Ahead | None = None

    @property
    def ahead_radians(self) -> float | None:
        """That direction, clockwise from the picture's up."""
        return None if self.ahead is None else AHEAD_RADIANS[self.ahead]


def calibrate(
    photos: Sequence[Path], output: Path, options: CalibrateOptions, *, overwrite: bool
) -> Report:
    """Calibrate from each photo and write the files.

    One photo: `output` (a .yaml file, or a folder for calibration.yaml) and its check picture, the
    same name with .png. Several: `output` is the best one's, and each photo's own calibration and
    picture go beside it, named after it and the photo.

    Raises
    ------
    InputError, CalibrationError, OutputError
        CalibrationError when no photo yields a calibration.
    """
    _check(options, photos)
    path = output if output.suffix.lower() in _YAML_SUFFIXES else output / "calibration.yaml"
    own = [path.with_name(f"{path.stem}_{photo.stem}{path.suffix}") for photo in photos]
    if len(set(own)) < len(own):
        raise InputError("two photos have the same name; rename one, or calibrate one at a time")
    inputs = (*photos, options.intrinsics_path)
    for place in [path] if len(photos) == 1 else [path, *own]:
        refuse_existing(place, inputs=inputs, overwrite=overwrite)
        refuse_existing(place.with_suffix(".png"), inputs=inputs, overwrite=overwrite)
    intrinsics = options.intrinsics_path and load_intrinsics(options.intrinsics_path)
    results: list[Result] = []
    failures: list[str] = []
    for photo in photos:
        try:
            results.append(_calibrate(photo, options, intrinsics or None))
        except SlamcliError as error:
            if len(photos) == 1:
                raise
            failures.append(f"{photo.name}: {error}")
    if not results:
        raise CalibrationError(f"no photo yields a calibration; {failures[0]}")
    if len(photos) == 1:
        _write(path, results[0], options)
        wrote = f"wrote {path} and {path.with_suffix('.png').name}"
        return Report((*describe(results[0]), wrote), _facts(path, results[0]))
    best, reason = choose_best(results)
    for place, result in zip(own, _aligned(photos, results), strict=True):
        if result is not None:
            _write(place, result, options)
    _write(path, best, options)
    lines = [
        *compare(results),
        *[f"not calibrated: {failure}" for failure in failures],
        f"best: {best.photo.name}, {reason}",
        *describe(best),
        f"wrote {path} (the best), and each photo's own beside it",
    ]
    placed = zip(own, _aligned(photos, results), strict=True)
    others = [_facts(place, result) for place, result in placed if result is not None]
    facts = {**_facts(path, best), "reason": reason, "failures": failures, "photos": others}
    return Report(tuple(lines), facts)


def _facts(path: Path, result: Result) -> dict[str, object]:
    """Return a calibration as facts."""
    return {
        "photo": result.photo,
        "output": path,
        "target": result.target.name,
        **camera_section(result.calibration),
        "area_square_metres": result.area,
        "resolved_area_square_metres": result.resolved_area,
        "near_metres": result.near_metres,
        "notes": result.target.notes,
    }


def _check(options: CalibrateOptions, photos: Sequence[Path]) -> None:
    if not options.side_metres > 0 or not np.isfinite(options.side_metres):
        raise InputError(f"--side {options.side_metres:g}: give a length above 0 metres")
    if options.max_range_metres is not None and not options.max_range_metres > 0:
        raise InputError(f"--max-range {options.max_range_metres:g}: give a range above 0 metres")
    targets = [options.corners, options.chessboard, options.marker]
    if sum(target is not None for target in targets) > 1:
        raise InputError("give only one of --corners, --chessboard and --aruco")
    if options.corners is not None and len(photos) > 1:
        raise InputError("--corners are those of one photo; calibrate several one at a time")
    if options.refine and options.corners is None:
        raise InputError("--refine moves the given corners; give them with --corners")


def _calibrate(photo: Path, options: CalibrateOptions, intrinsics: Intrinsics | None) -> Result:
    try:
        image = read_image(photo)
    except FrameError as error:
        raise InputError(f"cannot use the photo {photo}: {error}") from error
    size = (image.shape[1], image.shape[0])
    if intrinsics is not None and intrinsics.image_size != size:
        raise CalibrationError(
            f"{photo} has {size[0]}x{size[1]} pixels, but {options.intrinsics_path} is for "
            f"{intrinsics.image_size[0]}x{intrinsics.image_size[1]}"
        )
    target = find_target(image, options, intrinsics)
    if intrinsics is None:
        prior = _noted_focal(photo, size)
        mounting = solving.solve_mounting(target.points, size, prior, options.ahead_radians)
    else:
        mounting = solving.solve_mounting_with_intrinsics(
            target.points, intrinsics, options.ahead_radians
        )
    calibration = solving.make_calibration(mounting, size, intrinsics, options.max_range_metres)
    floor = seen_floor(calibration)
    area, resolved = floor_areas(calibration)
    resampler = view.make_view_resampler(
        calibration, view.registration_metres_per_pixel(calibration)
    )
    seen = view.make_view(Frame(0, photo.name, None, image), resampler, gray=True)
    count = len(features.extract(seen, calibration, FeatureOptions(count=_COMPARED_FEATURES)))
    near = float(np.hypot(floor[:, 0], floor[:, 1]).min())
    return Result(
        photo, image, target, mounting, calibration, area, resolved, near, feature_count=count
    )


def _noted_focal(photo: Path, size: tuple[int, int]) -> solving.FocalPrior | None:
    """Return the focal length that a photo notes in its EXIF; None where it notes none."""
    noted = read_photo_info(photo).focal_pixels(size)
    return None if noted is None else solving.FocalPrior(noted, _NOTED_FOCAL_SIGMA)


def find_target(
    image: UInt8Array, options: CalibrateOptions, intrinsics: Intrinsics | None
) -> Target:
    """Return the chessboard, the marker, the given corners or the square found in a photo."""
    size = (image.shape[1], image.shape[0])
    lens = intrinsics or _plain_lens(size)
    if options.chessboard is not None:
        return _chessboard(image, options, lens)
    if options.corners is not None:
        corners = solving.sort_corners(options.corners, size)
        return _given_corners(image, corners, options, intrinsics)
    name = "square"
    notes: list[str] = []
    if options.marker is not None:
        marker, number = board.find_marker(image, options.marker)
        found = square.refine_square(image, solving.sort_corners(marker, size), lens, options.gamma)
        name = f"aruco {options.marker.lower()} {number}"
    else:
        found, notes = _search_square(image, intrinsics, options.gamma)
    return _square_target(name, found, options, intrinsics, notes)


def _square_target(
    name: str,
    found: square.Square,
    options: CalibrateOptions,
    intrinsics: Intrinsics | None,
    notes: Sequence[str],
) -> Target:
    floor = solving.square_target(options.side_metres)
    points = solving.FloorPoints(floor, found.quad.corners, found.quad.covariance)
    return Target(name, points, found.corners, (*notes, *_bow_note(found, intrinsics)))


def _chessboard(image: UInt8Array, options: CalibrateOptions, lens: Lens) -> Target:
    assert options.chessboard is not None
    columns, rows = (round(count) for count in options.chessboard)
    grid, pixels, covariance = board.find_chessboard(
        image, columns, rows, options.side_metres, options.gamma
    )
    points = solving.FloorPoints(grid, undistort_points(lens, pixels), covariance)
    ends = [0, columns - 1, columns * rows - 1, columns * (rows - 1)]
    return Target(f"chessboard {columns}x{rows}", points, pixels[ends], ())


def _given_corners(
    image: UInt8Array,
    corners: Float64Array,
    options: CalibrateOptions,
    intrinsics: Intrinsics | None,
) -> Target:
    """Return the square of given corners, moved to the picture's edges where these are found."""
    lens = intrinsics or _plain_lens((image.shape[1], image.shape[0]))
    if options.refine is not False:
        try:
            found = square.refine_square(image, corners, lens, options.gamma)
        except CalibrationError:
            if options.refine:
                raise
        else:
            notes = _moved_note(corners, found.corners)
            return _square_target("square", found, options, intrinsics, notes)
    covariance = np.eye(8) * _GIVEN_CORNER_SIGMA_PIXELS**2
    floor = solving.square_target(options.side_metres)
    points = solving.FloorPoints(floor, undistort_points(lens, corners), covariance)
    return Target("square", points, corners, ())


def _moved_note(given: Float64Array, found: Float64Array) -> tuple[str, ...]:
    off = float(np.linalg.norm(found - given, axis=1).max())
    if off <= _MAX_CORNER_ERROR_PIXELS:
        return ()
    return (
        f"the given corners are moved by up to {off:.1f} px, to where the picture's edges meet; "
        "--no-refine keeps them",
    )


def _search_square(
    image: UInt8Array, intrinsics: Intrinsics | None, gamma: Gamma
) -> tuple[square.Square, list[str]]:
    """Return the square found in a photo, and a note where another may be meant."""
    size = (image.shape[1], image.shape[0])
    squareness = partial(
        solving.squareness,
        image_size=size,
        intrinsics=intrinsics,
        tolerance_pixels=_TOLERANCE_SHARE * size[0],
    )
    lens = intrinsics or _plain_lens(size)
    found, *others = square.find_squares(image, lens, squareness, gamma)
    return found, [
        f"there is another square, {other.score / found.score:.0%} as good; if that one is the "
        f'target, give --corners "{corner_text(other.corners)}"'
        for other in others[:1]
    ]


def _plain_lens(size: tuple[int, int]) -> Intrinsics:
    """Return a lens without distortion; nothing reads its focal length."""
    column, row = image_centre(size)
    matrix = np.array([[size[0], 0.0, column], [0.0, size[0], row], [0.0, 0.0, 1.0]])
    return Intrinsics(matrix, np.zeros(5), "plumb_bob", size)


def _bow_note(found: square.Square, intrinsics: Intrinsics | None) -> list[str]:
    corners = found.quad.corners
    longest = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).max())
    bow = abs(found.quad.bow_pixels)
    if bow < max(_MAX_BOW_PIXELS, _MAX_BOW_SHARE * longest):
        return []
    remedy = "give --intrinsics" if intrinsics is None else "check --intrinsics"
    cause = "the lens distorts or the floor is uneven"
    return [f"the square's sides bend by up to {bow:.1f} px: {cause}; {remedy}"]


def _write(path: Path, result: Result, options: CalibrateOptions) -> None:
    calibration, target = result.calibration, result.target
    corners = apply_homography(
        calibration.robot_from_image, undistort_points(calibration, target.outline)
    )
    grid = birdseye_grid(calibration, corners)
    # Past the far limit too, as far as the picture shows it: the square may lie there.
    reach = float(np.hypot(*grid.corners.T).max())
    wide = replace(calibration, max_range_metres=max(reach, calibration.max_range_metres))
    frame = Frame(0, result.photo.name, None, result.image)
    resampler = view.make_resampler(wide, resolution_image(wide), grid, Pose2())
    birdseye = view.make_view(frame, resampler, gray=False)
    picture = draw_calibration(
        result.image, target.outline, calibration, birdseye, describe(result)
    )
    origin = CalibrationSource(result.photo.name, target.name, options.side_metres, target.outline)
    save_calibration(path, calibration, origin)
    write_drawing(path.with_suffix(".png"), picture)


def _aligned(photos: Sequence[Path], results: Sequence[Result]) -> list[Result | None]:
    by_photo = {result.photo: result for result in results}
    return [by_photo.get(photo) for photo in photos]
