"""Comparison of camera mountings: what each sees of the floor, in lines and in a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull, seen_floor
from slamcli.core.camera.resolution import floor_sampling
from slamcli.stages import calibrate as solving

# Where a pixel covers more floor than this, no scuff, seam or painted edge is sharp.
RESOLVED_METRES_PER_PIXEL = 0.002
# Mountings that resolve nearly as much floor, less by up to this share, count as equal.
_EQUAL_SHARE = 0.05
# A smaller residual is not reported, however small its sigma.
_MAX_RESIDUAL_PIXELS = 0.3
# An error of the floor by the lens that is reported, one sigma, as a share of its distance.
_MAX_LENS_SIGMA = 0.01
# A camera that is rolled by more is named: upside down, or on its side.
_MAX_USUAL_ROLL_RADIANS = math.radians(45.0)


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """The calibration target found in a photo.

    Attributes
    ----------
    name : str
        Such as ``square`` or ``chessboard 8x6``.
    points : FloorPoints
    outline : (4, 2) float64
        Pixels of the photo.
    notes : tuple of str
        Remarks for the user.
    """

    name: str
    points: solving.FloorPoints
    outline: Float64Array
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One photo's calibration, and how much floor its mounting shows.

    Attributes
    ----------
    photo : Path
    image : (H, W, 3) uint8
    target : Target
    mounting : Mounting
    calibration : Calibration
    area, resolved_area : float
        Square metres of floor kept, and of those the part that a pixel of at most
        `RESOLVED_METRES_PER_PIXEL` sees.
    near_metres : float
    feature_count : int
        ORB points in the kept part of the bird's-eye view.
    """

    photo: Path
    image: UInt8Array
    target: Target
    mounting: solving.Mounting
    calibration: Calibration
    area: float
    resolved_area: float
    near_metres: float
    feature_count: int


def compare(results: Sequence[Result]) -> list[str]:
    """Return a table, one line a photo, of what each mounting sees of the floor."""
    header = (
        f"{'photo':<24}{'pitch':>8}{'height':>9}{'area':>10}{'resolved':>10}{'near':>8}{'far':>8}"
        f"{'mm/px near':>13}{'1 m':>13}{'far':>13}{'ORB':>7}"
    )
    lines = [header]
    for result in results:
        calibration = result.calibration
        cells = [_cell(sampling) for _, sampling in _sampling(result)]
        lines.append(
            f"{result.photo.name[:23]:<24}{np.degrees(calibration.pitch_radians):>7.1f}°"
            f"{calibration.height_metres:>7.3f} m{result.area:>7.3f} m²"
            f"{result.resolved_area:>7.3f} m²"
            f"{result.near_metres:>6.2f} m{calibration.max_range_metres:>6.2f} m"
            + "".join(f"{cell:>13}" for cell in cells)
            + f"{result.feature_count:>7}"
        )
    return lines


def choose_best(results: Sequence[Result]) -> tuple[Result, str]:
    """Return the mounting that resolves most floor, and why; near-equal ones by their features.

    A steep camera sees little floor, a flat one sees much of it smeared. What counts is the area
    that is both kept and seen at `RESOLVED_METRES_PER_PIXEL` or finer along the line of sight.
    """
    most = max(result.resolved_area for result in results)
    limit = f"{1000 * RESOLVED_METRES_PER_PIXEL:g} mm a pixel or finer"
    rivals = [result for result in results if result.resolved_area >= (1 - _EQUAL_SHARE) * most]
    best = max(rivals, key=lambda result: result.feature_count)
    if len(rivals) > 1:
        return best, (
            f"which resolves {best.resolved_area:.3f} m² of floor at {limit}, like "
            f"{len(rivals) - 1} more, and shows most ORB points there ({best.feature_count})"
        )
    return best, f"which resolves most floor: {best.resolved_area:.3f} m² at {limit}"


def floor_areas(calibration: Calibration) -> tuple[float, float]:
    """Return square metres of floor kept, and the part that is resolved."""
    hull = footprint_hull(calibration)
    x, y = hull.T
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    floor = seen_floor(calibration)
    sampling = floor_sampling(calibration, floor)
    # The points lie evenly in the picture, so each counts for as much floor as a pixel there.
    weight = sampling.prod(axis=1)
    resolved = sampling[:, 0] <= RESOLVED_METRES_PER_PIXEL
    return area, area * float(weight[resolved].sum() / weight.sum())


def _sampling(result: Result) -> list[tuple[str, Float64Array | None]]:
    """Return metres per pixel (along, across) at the near edge, at 1 m and at the far limit."""
    calibration = result.calibration
    far = calibration.max_range_metres
    places = [
        (f"the near edge ({result.near_metres:.2f} m)", result.near_metres),
        ("1 m" if far >= 1.0 else "1 m (not used)", 1.0),
        (f"the far limit ({far:.2f} m)", far),
    ]
    sampled: list[tuple[str, Float64Array | None]] = []
    for name, distance in places:
        ahead = np.array([[distance, 0.0]])
        depth = float(ahead[0] @ calibration.image_from_robot[2, :2]) + float(
            calibration.image_from_robot[2, 2]
        )
        sampling = floor_sampling(calibration, ahead)[0] if depth > 0 else None
        sampled.append((name, sampling))
    return sampled


def describe(result: Result) -> list[str]:
    """Return lines of text: the target, the numbers with their sigmas, and notes."""
    mounting, calibration, target = result.mounting, result.calibration, result.target
    sigma = np.degrees(mounting.sigmas[2:])
    focal = f"focal length {mounting.focal_pixels:.1f} ± {mounting.sigmas[0]:.1f} px, "
    if np.any(mounting.radial):
        pairs = zip(("k1", "k2"), mounting.radial, mounting.radial_sigmas, strict=True)
        focal += "".join(f"{name} {value:.4f} ± {sigma:.4f}, " for name, value, sigma in pairs)
    sampling = "; ".join(f"{_cell(value)} at {name}" for name, value in _sampling(result))
    misfit = []
    if (
        mounting.misfit_sigmas > solving.MISFIT_SIGMAS
        and mounting.residual_pixels > _MAX_RESIDUAL_PIXELS
    ):
        misfit = [
            f"note: the target fits a flat floor only to {mounting.residual_pixels:.1f} px "
            f"({mounting.misfit_sigmas:.0f} sigmas); check the corners, and that it lies flat"
        ]
    return [
        f"{result.photo.name}: {target.name}, corners {corner_text(target.outline)}",
        f"{focal if mounting.sigmas[0] > 0 else ''}height {1000 * calibration.height_metres:.1f} ± "
        f"{1000 * mounting.sigmas[1]:.1f} mm, pitch {np.degrees(calibration.pitch_radians):.2f} ± "
        f"{sigma[0]:.2f}°, roll {np.degrees(calibration.roll_radians):z.2f} ± {sigma[1]:.2f}°",
        f"one pixel covers, mm of floor along x across the line of sight: {sampling}",
        f"floor kept: {result.area:.3f} m², {result.near_metres:.2f} to "
        f"{calibration.max_range_metres:.2f} m; ORB points in it: {result.feature_count}",
        *[f"note: {note}" for note in (*target.notes, *_mounting_notes(result))],
        *misfit,
    ]


def _mounting_notes(result: Result) -> list[str]:
    """Return what the user should know of an unusual mounting."""
    mounting, calibration = result.mounting, result.calibration
    notes = []
    if mounting.focal_assumed:
        share = mounting.sigmas[0] / mounting.focal_pixels
        notes.append(
            f"the {result.target.name}, seen from about straight above, does not show the focal "
            f"length: {mounting.focal_pixels:.0f} px ± {share:.0%} is taken, as the photo "
            "notes it or else as is usual. Lengths on the "
            "floor are right all the same, the height is not; for it give --intrinsics "
            "camera_info.yaml, or a photo from a slant"
        )
    lens_sigma = solving.lens_sigma(mounting, calibration)
    if lens_sigma > _MAX_LENS_SIGMA:
        notes.append(
            f"the {result.target.name} shows the lens too little towards the picture's corners: "
            f"places on the floor there are uncertain by {lens_sigma:.1%} of their distance; fill "
            "the picture with it, or give --intrinsics camera_info.yaml"
        )
    if not math.isnan(mounting.ahead_radians):
        degrees = math.degrees(mounting.ahead_radians)
        word = {0.0: "up", 90.0: "right", 180.0: "down", -90.0: "left"}[round(degrees, 6)]
        notes.append(f"ahead (x) is the picture's {word}; --ahead says otherwise")
    elif abs(calibration.roll_radians) > _MAX_USUAL_ROLL_RADIANS:
        notes.append(
            f"the camera is rolled by {math.degrees(calibration.roll_radians):.0f}° about its "
            "axis: upside down, or on its side"
        )
    return notes


def _cell(sampling: Float64Array | None) -> str:
    return "-" if sampling is None else f"{1000 * sampling[0]:.2f} x {1000 * sampling[1]:.2f}"


def corner_text(corners: Float64Array) -> str:
    """Return corners, pixels, in the form that --corners takes."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
