"""Metres for a map of frames from above without a calibration: a height, a scale bar, or points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import rocked
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.robust import NORMAL_MEDIAN
from slamcli.io.control_points import ControlPoints, read_control_points
from slamcli.io.frames import FrameFile
from slamcli.run.stitch.drive import LocatedDrive
from slamcli.run.stitch.on_earth import in_metres
from slamcli.run.stitch.options import ScaleBar, StitchOptions
from slamcli.selfcal import RegisteredDrive
from slamcli.stages.geodesy import LocalPlane

# A point is an outlier beyond so many sigmas of the others, and this share of their extent.
_OUTLIER_SIGMAS, _MIN_OUTLIER_SHARE = 3.0, 0.002


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The similarity from map to ground.

    Attributes
    ----------
    metres_per_unit : float
    ground_from_map : Pose2
        After scaling.
    residuals : (N,) float64
        Metres.
    inliers : (N,) bool
    """

    metres_per_unit: float
    ground_from_map: Pose2
    residuals: Float64Array
    inliers: BoolArray


def read_control(options: StitchOptions, files: Sequence[FrameFile]) -> ControlPoints | None:
    """Return the control points; raises InputError, also when they or the bar name no frame."""
    names = {file.name for file in files}
    points = None if options.control is None else read_control_points(options.control)
    if points is not None:
        _check_names(points.frames, names, str(options.control))
        points = from_first(points)
    if options.scale is not None:
        _check_names([options.scale.frame], names, "--scale")
    return points


def from_first(points: ControlPoints) -> ControlPoints:
    """Return points in metres: latitudes and longitudes east and north of the first point."""
    if not points.geodetic:
        return points
    latitude, longitude = points.places[0].tolist()
    plane = LocalPlane((latitude, longitude))
    metres = np.array([plane.east_north(*place) for place in points.places.tolist()])
    return replace(points, places=metres, geodetic=False)


def _check_names(frames: Sequence[str], names: set[str], source: str) -> None:
    unknown = next((frame for frame in frames if frame not in names), None)
    if unknown is not None:
        raise InputError(f"{source} names {unknown}, which is none of the frames")


def with_metres(located: LocatedDrive, points: ControlPoints | None) -> LocatedDrive:
    """Return a drive in metres, where the options say how long a unit of its map is.

    Raises
    ------
    InputError
        When a scale is given for a camera that looks ahead; with the height to give instead.
    """
    options, calibration = located.drive.options, located.calibration
    if calibration.unit == "m" or not any(e.map_from_robot for e in located.estimates):
        return located
    if points is not None:
        fit = _fit_points(points, located)
        row = "not applied: fewer than two points lie in the largest map"
        if fit is not None:
            row = _described(fit, points)
    elif options.scale is not None:
        fit = _fit_bar(options.scale, located)
        row = f"not applied: {options.scale.frame} is not in the map"
        if fit is not None:
            row = f"by the scale bar: 1 {calibration.unit} is {fit.metres_per_unit:.4g} m"
    elif options.height_metres is not None and calibration.is_top_down:
        focal = float(calibration.camera_matrix[0, 0])
        fit = _Fit(options.height_metres / focal, Pose2(), np.zeros(0), np.zeros(0, np.bool_))
        row = f"by the height and a focal length of {focal:.0f} px"
    else:
        return located
    located = replace(located, scale_rows=(("scale", row),))
    if fit is None:
        return located
    if not calibration.is_top_down:
        raise InputError(
            "--scale and --control are for frames from above; by them this camera is "
            f"{fit.metres_per_unit:.4g} m high: give --height {fit.metres_per_unit:.4g} instead"
        )
    return replace(located, registered=_on_ground(located.registered, fit))


def _on_map(located: LocatedDrive, frame: str, pixels: Float64Array) -> Float64Array | None:
    """Return (N, 2) places in the largest map of pixels of a frame; None if it is not there."""
    for one in located.estimates:
        if one.name == frame and one.map_from_robot is not None and one.fragment == 0:
            calibration = located.calibration
            own = calibration if one.rocking is None else rocked(calibration, one.rocking)
            floor = apply_homography(own.robot_from_image, undistort_points(own, pixels))
            return np.asarray(one.map_from_robot.apply(floor), np.float64)
    return None


def _fit_bar(bar: ScaleBar, located: LocatedDrive) -> _Fit | None:
    ends = _on_map(located, bar.frame, np.array([bar.first, bar.second]))
    if ends is None:
        return None
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return _Fit(bar.metres / length, Pose2(), np.zeros(0), np.zeros(0, np.bool_))


def _fit_points(points: ControlPoints, located: LocatedDrive) -> _Fit | None:
    """Return the robust similarity (least median of squares); None for fewer than two points."""
    places = np.full((len(points.frames), 2), np.nan)
    for number, frame in enumerate(points.frames):
        found = _on_map(located, frame, points.pixels[number : number + 1])
        if found is not None:
            places[number] = found[0]
    usable = ~np.isnan(places[:, 0])
    z, w = places @ [1.0, 1.0j], points.places @ [1.0, 1.0j]
    best, least = None, math.inf
    for a, b in combinations(np.flatnonzero(usable).tolist(), 2):
        if z[a] == z[b] or w[a] == w[b]:
            continue
        factor = (w[b] - w[a]) / (z[b] - z[a])
        errors = np.abs(factor * (z - z[a]) + w[a] - w)
        median = float(np.median(errors[usable]))
        if median < least:
            best, least = errors, median
    if best is None:
        return None
    spread = least / NORMAL_MEDIAN * (1.0 + 5.0 / max(1, usable.sum() - 2))
    extent = float(np.ptp(points.places, axis=0).max())
    limit = max(_OUTLIER_SIGMAS * spread, _MIN_OUTLIER_SHARE * extent)
    inliers = usable & (np.nan_to_num(best, nan=math.inf) <= limit)
    centre, target = z[inliers].mean(), w[inliers].mean()
    factor = complex(
        np.vdot(z[inliers] - centre, w[inliers] - target)
        / np.vdot(z[inliers] - centre, z[inliers] - centre)
    )
    shift = complex(target - factor * centre)
    pose = Pose2(shift.real, shift.imag, math.atan2(factor.imag, factor.real))
    residuals = np.abs(factor * z + shift - w)
    return _Fit(abs(factor), pose, np.asarray(residuals, np.float64), inliers)


def _described(fit: _Fit, points: ControlPoints) -> str:
    rms = math.sqrt(float(np.mean(fit.residuals[fit.inliers] ** 2)))
    text = f"by {int(fit.inliers.sum())} control points, {rms:.3g} m RMS"
    for number in np.flatnonzero(~fit.inliers).tolist():
        column, row = points.pixels[number]
        error = fit.residuals[number]
        far = "not in the map" if math.isnan(error) else f"{error:.3g} m off"
        text += f"; outlier {points.frames[number]} {column:g},{row:g}: {far}"
    return text


def _on_ground(registered: RegisteredDrive, fit: _Fit) -> RegisteredDrive:
    """Return the drive in metres, the largest map moved to the ground's coordinates."""
    scaled = in_metres(registered, {}, fit.metres_per_unit)
    estimates = [
        replace(one, map_from_robot=fit.ground_from_map @ one.map_from_robot)
        if one.map_from_robot is not None and one.fragment == 0
        else one
        for one in scaled.estimates
    ]
    floor_map = scaled.floor_map
    if floor_map is not None:
        # Keyframes are of another unit: the map is to be rendered, not to locate in.
        floor_map = replace(floor_map, keyframes=(), estimates=tuple(estimates))
    return replace(scaled, estimates=estimates, floor_map=floor_map)
