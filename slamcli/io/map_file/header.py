"""What a map file says of its camera and its points, each value checked before it is used."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any, get_args

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, DistortionModel, Unit
from slamcli.core.config import FeatureMethod, FeatureOptions
from slamcli.core.errors import MapError

_MAX_SIDE_PIXELS = 32_768
MAX_METRES = 1e7
MAX_POINTS = 100_000
_FEATURE_RANGES: dict[str, tuple[float, float]] = {
    "count": (1, MAX_POINTS),
    "scale_factor": (1.01, 4.0),
    "levels": (1, 32),
    "edge_threshold": (1, 1024),
    "first_level": (0, 31),
    "wta_k": (2, 4),
    "patch_size": (5, 1024),
    "fast_threshold": (1, 255),
    "min_fast_threshold": (1, 255),
    "contrast_threshold": (0.0, 1e3),
    "clean_kernel_pixels": (1, 1024),
    "clean_threshold": (0, 255),
    "roi_border_pixels": (0, 4096),
}
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}


def parse_features(section: Any) -> FeatureOptions:
    """Return feature options of which every value is of its kind and range."""
    known = {field.name: getattr(FeatureOptions(), field.name) for field in fields(FeatureOptions)}
    if set(section) != set(known):
        raise MapError("its feature options are not those of this version")
    for name, default in known.items():
        value = section[name]
        if type(value) is not type(default) and not (
            isinstance(default, float) and type(value) is int
        ):
            raise MapError(f"its feature option {name} is {value!r}")
        if name in _FEATURE_RANGES:
            parse_number(value, name, *_FEATURE_RANGES[name])
    parse_word(section["method"], get_args(FeatureMethod), "method")
    return FeatureOptions(**section)


def calibration_header(calibration: Calibration) -> dict[str, Any]:
    """Return a calibration as JSON can hold it: nan as null."""
    header: dict[str, Any] = {}
    for field in fields(calibration):
        value = getattr(calibration, field.name)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, float) and math.isnan(value):
            value = None
        header[field.name] = value
    return header


def parse_calibration(section: Any) -> Calibration:
    """Return a calibration of which every number can be of a camera."""
    model: DistortionModel = parse_word(
        section["distortion_model"], get_args(DistortionModel), "distortion_model"
    )
    width, height = section["image_size"]
    size = tuple(
        int(parse_number(side, "image_size", 1, _MAX_SIDE_PIXELS)) for side in (width, height)
    )
    distortion = _matrix(section["distortion"], "distortion")
    if distortion.ndim != 1 or len(distortion) not in _COEFFICIENTS[model]:
        raise MapError(f"its distortion has shape {distortion.shape}, which {model} does not have")
    unit: Unit = parse_word(section["unit"], get_args(Unit), "unit")
    numbers = {
        name: math.nan
        if section[name] is None
        else parse_number(section[name], name, low, MAX_METRES)
        for name, low in (
            ("height_metres", 0.0),
            ("pitch_radians", -math.pi),
            ("roll_radians", -math.pi),
            ("focal_sigma_pixels", 0.0),
            ("height_sigma_metres", 0.0),
            ("pitch_sigma_radians", 0.0),
            ("roll_sigma_radians", 0.0),
        )
    }
    return Calibration(
        camera_matrix=_square(section["camera_matrix"], "camera_matrix"),
        distortion=distortion,
        distortion_model=model,
        image_size=(size[0], size[1]),
        robot_from_image=_square(section["robot_from_image"], "robot_from_image"),
        max_range_metres=parse_number(
            section["max_range_metres"], "max_range_metres", 1e-6, MAX_METRES
        ),
        unit=unit,
        **numbers,
    )


def _square(value: Any, name: str) -> Float64Array:
    matrix = _matrix(value, name)
    if matrix.shape != (3, 3) or not abs(np.linalg.det(matrix)) > 0.0:
        raise MapError(f"its {name} is not a (3, 3) matrix that can be inverted")
    return matrix


def _matrix(value: Any, name: str) -> Float64Array:
    matrix = np.array(value, np.float64)
    if matrix.size > 16 or not np.all(np.abs(matrix) < MAX_METRES):
        raise MapError(f"its {name} holds a number that is out of range")
    return matrix


def parse_number(value: Any, name: str, low: float, high: float) -> float:
    """Return a number that lies where it is sound; raises MapError for any other."""
    if type(value) not in {int, float} or not low <= value <= high:
        raise MapError(f"its {name} is {value!r}; {low:g} to {high:g} is sound")
    return float(value)


def parse_word(value: Any, words: tuple[Any, ...], name: str) -> Any:
    """Return one of some words; raises MapError for any other."""
    if value not in words:
        raise MapError(f"its {name} is {value!r}; one of {', '.join(words)} is known")
    return value
