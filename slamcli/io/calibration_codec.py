"""A calibration as plain values and back, checked: for calibration.yaml, map.slam and run.toml."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, get_args

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import LENGTH, MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE, Bounds, quoted
from slamcli.core.camera.calibration import Calibration, DistortionModel, Intrinsics, Unit
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.geometry import apply_homography
from slamcli.io.checks import (
    FieldError,
    check_array,
    check_matrix,
    check_number,
    check_word,
    required,
)

_SIDE = Bounds(1, MAX_IMAGE_SIDE)
_SIGMA = Bounds(0.0, LENGTH.high)
_HALF_TURN = Bounds(-math.pi, math.pi)
_COEFFICIENT_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_ANGLES = ("pitch_radians", "roll_radians")
_SIGMAS = (
    "focal_sigma_pixels",
    "height_sigma_metres",
    "pitch_sigma_radians",
    "roll_sigma_radians",
)
# A robot_from_image rounded by hand still agrees with the mounting to this share of its distances
# [guarded by tests/io/test_calibrations.py: six digits of each number].
_MAX_DISAGREEMENT = 1e-3
# Rounding of a covariance, as a share of its largest number.
_COVARIANCE_TOLERANCE = 1e-6


def to_dict(calibration: Calibration) -> dict[str, Any]:
    """Return every field of a calibration by its name: arrays as lists, nan as None.

    Without a direction in the picture that points ahead `ahead_radians` is left out.
    """
    plain: dict[str, Any] = {}
    for field in fields(calibration):
        value = getattr(calibration, field.name)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, int | float):
            value = None if math.isnan(value) else float(value)
        plain[field.name] = value
    if plain["ahead_radians"] is None:
        del plain["ahead_radians"]
    return plain


def from_dict(section: Mapping[str, Any]) -> Calibration:
    """Return the calibration that `to_dict` made plain, every value checked.

    `robot_from_image` may be left out, to be composed from the camera matrix, height, pitch and
    roll; where it is given it must agree with these. The unit is metres unless it is given, and
    sigmas and the direction ahead may be left out.

    Raises
    ------
    FieldError
        When a key is missing, of a wrong type, shape or range, or contradicts another one.
    """
    intrinsics = intrinsics_from_dict(section)
    unit: Unit = check_word(section.get("unit", "m"), "unit", get_args(Unit))
    mounting = _mounting(section, unit)
    ahead = _number_or_nan(section.get("ahead_radians"), "ahead_radians", _HALF_TURN)
    max_range = required(section, "max_range_metres")
    return Calibration(
        camera_matrix=intrinsics.camera_matrix,
        distortion=intrinsics.distortion,
        distortion_model=intrinsics.distortion_model,
        image_size=intrinsics.image_size,
        robot_from_image=_robot_from_image(section, intrinsics, {**mounting, "ahead": ahead}),
        max_range_metres=check_number(max_range, "max_range_metres", LENGTH),
        unit=unit,
        ahead_radians=ahead,
        **mounting,
        **{name: _number_or_nan(section.get(name), name, _SIGMA) for name in _SIGMAS},
        covariance=_covariance(section.get("covariance")),
    )


def intrinsics_from_dict(section: Mapping[str, Any]) -> Intrinsics:
    """Return lens and sensor alone; without `distortion` there is none. Raises FieldError."""
    matrix = check_matrix(required(section, "camera_matrix"), "camera_matrix", (3, 3), LENGTH.high)
    upright = np.array_equal(matrix[2], [0.0, 0.0, 1.0]) and matrix[1, 0] == 0.0
    if not upright or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        form = "[fx, 0, cx; 0, fy, cy; 0, 0, 1]"
        raise FieldError("camera_matrix", f"is singular or not of the form {form}")
    word = section.get("distortion_model", "plumb_bob")
    model: DistortionModel = check_word(word, "distortion_model", get_args(DistortionModel))
    counts = _COEFFICIENT_COUNTS[model]
    distortion = np.zeros(counts[-1])
    if "distortion" in section:
        distortion = check_array(section["distortion"], "distortion").reshape(-1)
        if len(distortion) not in counts:
            allowed = " or ".join(map(str, counts))
            raise FieldError("distortion", f"has {len(distortion)} numbers; {model} has {allowed}")
    return Intrinsics(matrix, distortion, model, _image_size(section))


def _image_size(section: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height, pixels."""
    size = required(section, "image_size")
    if not isinstance(size, list | tuple) or len(size) != 2:
        raise FieldError("image_size", f"is {quoted(size)}; width and height are needed")
    for side, key in zip(size, ("image_size width", "image_size height"), strict=True):
        if check_number(side, key, _SIDE) != round(side):
            raise FieldError(key, f"is {quoted(side)}; whole pixels are needed")
    if size[0] * size[1] > MAX_IMAGE_PIXELS:
        raise FieldError(
            "image_size", f"is {size[0]:g}x{size[1]:g}, more than {MAX_IMAGE_PIXELS} pixels"
        )
    return int(size[0]), int(size[1])


def _mounting(section: Mapping[str, Any], unit: Unit) -> dict[str, float]:
    """Return height (m), pitch and roll (rad); nan for each that is not known."""
    value = required(section, "height_metres")
    mounting = {"height_metres": _number_or_nan(value, "height_metres", LENGTH)}
    for name in _ANGLES:
        value = required(section, name)
        mounting[name] = _number_or_nan(value, name, _HALF_TURN)
    known = next((name for name, value in mounting.items() if not math.isnan(value)), None)
    if unit == "px" and known is not None:
        raise FieldError(known, "is given, but the unit px is for top-down frames, which have none")
    return mounting


def _number_or_nan(value: Any, key: str, limits: Bounds) -> float:
    """Return a number within bounds; nan for None and nan, which mean unknown."""
    if value is None or (type(value) is float and math.isnan(value)):
        return math.nan
    return check_number(value, key, limits)


def _covariance(value: Any) -> Float64Array | None:
    """Return the covariance of log focal length, log height, pitch and roll; None for None."""
    if value is None or (type(value) is float and math.isnan(value)):
        return None
    covariance = check_matrix(value, "covariance", (4, 4), LENGTH.high)
    tolerance = _COVARIANCE_TOLERANCE * float(np.abs(covariance).max())
    uneven = float(np.abs(covariance - covariance.T).max())
    if uneven > tolerance or float(np.linalg.eigvalsh(covariance)[0]) < -tolerance:
        raise FieldError("covariance", "is no covariance: symmetric, without negative variances")
    return covariance


def _robot_from_image(
    section: Mapping[str, Any], intrinsics: Intrinsics, mounting: Mapping[str, float]
) -> Float64Array:
    """Return the homography that is given, or else the one that the mounting composes."""
    unknown = next(
        (name for name, value in mounting.items() if math.isnan(value) and name != "ahead"), None
    )
    composed = None
    if unknown is None:
        composed = compose_robot_from_image(intrinsics.camera_matrix, *mounting.values())
    if "robot_from_image" not in section:
        if composed is None:
            raise FieldError(str(unknown), "is not known, and there is no robot_from_image")
        return composed
    given = check_matrix(section["robot_from_image"], "robot_from_image", (3, 3), LENGTH.high)
    if not abs(np.linalg.det(given)) > 0.0:
        raise FieldError("robot_from_image", "is singular: it cannot be inverted")
    if composed is not None:
        _check_agreement(given, composed, intrinsics.image_size)
    return given


def _check_agreement(
    given: Float64Array, composed: Float64Array, image_size: tuple[int, int]
) -> None:
    """Compare where both put pixels of the lower half, as far as those show floor."""
    width, height = image_size
    pixels = np.array([(x * width, y * height) for x in (0.1, 0.5, 0.9) for y in (0.7, 0.85, 1.0)])
    depth = np.column_stack([pixels, np.ones(len(pixels))]) @ composed[2]
    pixels = pixels[depth > 0]
    floor, other = apply_homography(composed, pixels), apply_homography(given, pixels)
    apart = np.linalg.norm(floor - other, axis=1) / np.linalg.norm(floor, axis=1)
    if len(apart) and not np.max(apart) < _MAX_DISAGREEMENT:
        raise FieldError(
            "robot_from_image",
            "does not agree with the camera matrix, height, pitch and roll; correct it, or leave "
            "it out",
        )
