"""Calibration files: a superset of ROS camera_info in YAML, written to be read by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import yaml
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, DistortionModel, Intrinsics
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.errors import CalibrationError, InputError
from slamcli.core.geometry import apply_homography
from slamcli.io.files import read_text, write_text

FORMAT_VERSION = 1
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
# ROS drivers write the fisheye model under either name.
_MODEL_SYNONYMS = {"fisheye": "equidistant", "kannala_brandt": "equidistant"}
# A robot_from_image rounded by hand still agrees with the mounting to this share of its distances.
_AGREEMENT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationSource:
    """What a calibration was made from; kept in its file for the reader.

    Attributes
    ----------
    photo : str
        Name of the picture.
    target : str
        ``square``, ``chessboard 8x6``, ``aruco 4x4_50`` ...
    side_metres : float
        Of the square, the marker or one field of the board.
    corners : (N, 2) float64
        Pixels of the photo.
    """

    photo: str
    target: str
    side_metres: float
    corners: Float64Array


def load_calibration(path: str | Path) -> Calibration:
    """Return the calibration in a YAML file as `save_calibration` writes it.

    ``ground_plane.robot_from_image`` may be left out; where it stands it must agree with the camera
    matrix, height, pitch and roll, from which the homography is always composed.

    Raises
    ------
    CalibrationError
        One line that names the file, the key and what is wrong with it.
    """
    path = Path(path)
    document = _read_document(path, "calibration")
    intrinsics = _parse_intrinsics(document, path)
    ground = document.get("ground_plane")
    if not isinstance(ground, dict):
        raise CalibrationError(
            f"{path}: no ground_plane section: this file knows the lens but not where the camera "
            "is mounted; make one by slam calibrate PHOTO --intrinsics"
        )
    version = ground.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise CalibrationError(
            f"{path}: ground_plane.format_version is {version}; this slamcli reads {FORMAT_VERSION}"
        )
    height = _number(ground, "height_metres", path)
    pitch = math.radians(_number(ground, "pitch_degrees", path))
    roll = math.radians(_number(ground, "roll_degrees", path))
    max_range = _number(ground, "max_range_metres", path)
    for key, value in (("height_metres", height), ("max_range_metres", max_range)):
        if value <= 0:
            raise CalibrationError(f"{path}: ground_plane.{key} is {value:g}; it must be above 0")
    matrix = intrinsics.camera_matrix
    composed = compose_robot_from_image(matrix, height, pitch, roll)
    if "robot_from_image" in ground:
        stored = _matrix(ground, "robot_from_image", (3, 3), path)
        _check_agreement(stored, composed, intrinsics.image_size, path)
    return Calibration(
        camera_matrix=matrix,
        distortion=intrinsics.distortion,
        distortion_model=intrinsics.distortion_model,
        image_size=intrinsics.image_size,
        robot_from_image=composed,
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=roll,
        max_range_metres=max_range,
        focal_sigma_pixels=_sigma(ground, "focal_sigma_pixels", path),
        height_sigma_metres=_sigma(ground, "height_sigma_metres", path),
        pitch_sigma_radians=math.radians(_sigma(ground, "pitch_sigma_degrees", path)),
        roll_sigma_radians=math.radians(_sigma(ground, "roll_sigma_degrees", path)),
    )


def load_origin(path: str | Path) -> CalibrationSource | None:
    """Return what a calibration file says it was made from; None where it does not say.

    Raises
    ------
    CalibrationError
    """
    path = Path(path)
    ground = _read_document(path, "calibration").get("ground_plane")
    made_from = ground.get("made_from") if isinstance(ground, dict) else None
    if not isinstance(made_from, dict) or not {"side_metres", "corners"} <= made_from.keys():
        return None
    return CalibrationSource(
        str(made_from.get("photo", "")),
        str(made_from.get("target", "")),
        _number(made_from, "side_metres", path),
        _array(made_from["corners"], "made_from.corners", path).reshape(-1, 2),
    )


def load_intrinsics(path: str | Path) -> Intrinsics:
    """Return the camera of a ROS camera_info YAML file (camera_calibration writes one).

    Raises
    ------
    CalibrationError
        One line that names the file, the key and what is wrong with it.
    """
    path = Path(path)
    return _parse_intrinsics(_read_document(path, "camera_info"), path)


def save_calibration(
    path: Path, calibration: Calibration, origin: CalibrationSource | None = None
) -> None:
    """Write a calibration whole or not at all; `load_calibration` returns the same numbers."""
    write_text(path, calibration_text(calibration, origin))


def calibration_text(calibration: Calibration, origin: CalibrationSource | None = None) -> str:
    """Return the YAML document of a calibration, with a comment on every number's unit."""
    width, height = calibration.image_size
    matrix = calibration.camera_matrix
    projection = np.hstack([matrix, np.zeros((3, 1))])
    return "\n".join(
        [
            "# A camera over a flat floor. Above ground_plane: ROS camera_info, in pixels.",
            f"image_width: {width}",
            f"image_height: {height}",
            "camera_name: camera",
            *_matrix_lines("camera_matrix", matrix),
            f"distortion_model: {calibration.distortion_model}",
            *_matrix_lines("distortion_coefficients", calibration.distortion[None]),
            *_matrix_lines("rectification_matrix", np.eye(3)),
            *_matrix_lines("projection_matrix", projection),
            "",
            "# Where the camera is mounted. The robot frame lies on the floor below the camera:",
            "# x ahead (the optical axis seen from above), y left. A sigma is one standard",
            "# deviation; .nan where it is not known.",
            "ground_plane:",
            f"  format_version: {FORMAT_VERSION}",
            f"  height_metres: {_text(calibration.height_metres)}  # of the camera above the floor",
            f"  pitch_degrees: {_text(_degrees(calibration.pitch_radians))}"
            "  # of the optical axis below the horizontal",
            f"  roll_degrees: {_text(_degrees(calibration.roll_radians))}"
            "  # positive: the right side is lower",
            f"  focal_sigma_pixels: {_text(calibration.focal_sigma_pixels)}",
            f"  height_sigma_metres: {_text(calibration.height_sigma_metres)}",
            f"  pitch_sigma_degrees: {_text(_degrees(calibration.pitch_sigma_radians))}",
            f"  roll_sigma_degrees: {_text(_degrees(calibration.roll_sigma_radians))}",
            f"  max_range_metres: {_text(calibration.max_range_metres)}"
            "  # floor beyond this distance is not used",
            "  # Undistorted pixel (column, row, 1) to floor metres (x, y, 1), up to scale.",
            "  # It may be left out; change it together with the numbers above.",
            *_matrix_lines("robot_from_image", calibration.robot_from_image, indent="  "),
            *_origin_lines(origin),
            "",
        ]
    )


def _origin_lines(origin: CalibrationSource | None) -> list[str]:
    if origin is None:
        return []
    corners = ", ".join(f"[{_text(x)}, {_text(y)}]" for x, y in np.round(origin.corners, 4))
    # JSON's quoting is YAML's double quoting, for any name.
    photo = yaml.safe_dump(origin.photo, allow_unicode=True, default_style='"', width=10**6)
    return [
        "  made_from:",
        f"    photo: {photo.strip()}",
        f"    target: {origin.target}",
        f"    side_metres: {_text(origin.side_metres)}",
        f"    corners: [{corners}]  # pixels of the photo",
    ]


def _matrix_lines(name: str, matrix: Float64Array, indent: str = "") -> list[str]:
    """Return rows, cols and data as camera_info has them, one line of numbers a matrix row."""
    rows, columns = matrix.shape
    opening = f"{indent}  data: ["
    lines = [", ".join(_text(value) for value in row) for row in matrix]
    data = f",\n{' ' * len(opening)}".join(lines)
    return [
        f"{indent}{name}:",
        f"{indent}  rows: {rows}",
        f"{indent}  cols: {columns}",
        f"{opening}{data}]",
    ]


def _text(value: float) -> str:
    """Return a number that YAML 1.1 reads back as the same float."""
    number = float(value)
    if math.isnan(number):
        return ".nan"
    text = repr(number + 0.0)
    mantissa, mark, exponent = text.partition("e")
    # Without a point, YAML 1.1 takes 1e-05 for a word.
    return f"{mantissa}.0e{exponent}" if mark and "." not in mantissa else text


def _degrees(radians: float) -> float:
    """Return the degrees that `math.radians` turns back into exactly these radians, if any do."""
    degrees = math.degrees(radians)
    near = (degrees, math.nextafter(degrees, math.inf), math.nextafter(degrees, -math.inf))
    return next((value for value in near if math.radians(value) == radians), degrees)


def _read_document(path: Path, what: str) -> dict[str, Any]:
    try:
        document = yaml.safe_load(read_text(path, what))
    except InputError as error:
        raise CalibrationError(str(error)) from error
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" (line {mark.line + 1})" if mark is not None else ""
        raise CalibrationError(f"{path}: not a {what} file: this is no YAML{where}") from error
    if not isinstance(document, dict):
        raise CalibrationError(f"{path}: not a {what} file: no keys such as camera_matrix in it")
    return document


def _parse_intrinsics(document: dict[str, Any], path: Path) -> Intrinsics:
    size = tuple(_whole(document, key, path) for key in ("image_width", "image_height"))
    matrix = _matrix(document, "camera_matrix", (3, 3), path)
    upright = np.array_equal(matrix[2], [0.0, 0.0, 1.0]) and matrix[1, 0] == 0.0
    if not upright or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise CalibrationError(
            f"{path}: camera_matrix is singular or not of the form [fx, 0, cx; 0, fy, cy; 0, 0, 1]"
        )
    name = str(document.get("distortion_model", "plumb_bob"))
    model = _MODEL_SYNONYMS.get(name, name)
    if model not in get_args(DistortionModel):
        known = ", ".join(get_args(DistortionModel))
        raise CalibrationError(f"{path}: distortion_model {name!r} is not one of {known}")
    counts = _COEFFICIENTS[model]
    distortion = np.zeros(counts[-1])
    if "distortion_coefficients" in document:
        distortion = _numbers(document, "distortion_coefficients", path)
        if len(distortion) not in counts:
            wanted = " or ".join(map(str, counts))
            raise CalibrationError(
                f"{path}: distortion_coefficients has {len(distortion)} numbers; "
                f"{model} has {wanted}"
            )
    return Intrinsics(matrix, distortion, cast("DistortionModel", model), (size[0], size[1]))


def _check_agreement(
    stored: Float64Array,
    composed: Float64Array,
    image_size: tuple[int, int],
    path: Path,
) -> None:
    """Compare where both put pixels of the lower half, as far as those show floor."""
    if abs(np.linalg.det(stored / np.abs(stored).max())) < 1e-12:
        raise CalibrationError(f"{path}: ground_plane.robot_from_image is singular")
    width, height = image_size
    pixels = np.array([(x * width, y * height) for x in (0.1, 0.5, 0.9) for y in (0.7, 0.85, 1.0)])
    depth = np.column_stack([pixels, np.ones(len(pixels))]) @ composed[2]
    pixels = pixels[depth > 0]
    floor, other = apply_homography(composed, pixels), apply_homography(stored, pixels)
    apart = np.linalg.norm(floor - other, axis=1) / np.linalg.norm(floor, axis=1)
    if len(apart) and not np.max(apart) < _AGREEMENT:
        raise CalibrationError(
            f"{path}: ground_plane.robot_from_image does not agree with camera_matrix, "
            "height_metres, pitch_degrees and roll_degrees; correct it, or leave it out"
        )


def _number(section: dict[str, Any], key: str, path: Path) -> float:
    if key not in section:
        raise CalibrationError(f"{path}: {key} is missing")
    return float(_array(section[key], key, path).reshape(-1)[0])


def _sigma(section: dict[str, Any], key: str, path: Path) -> float:
    value = section.get(key, math.nan)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CalibrationError(f"{path}: {key} is {value!r}, not a number")
    return float(value)


def _whole(section: dict[str, Any], key: str, path: Path) -> int:
    value = _number(section, key, path)
    if value < 1 or value != round(value):
        raise CalibrationError(f"{path}: {key} is {value:g}; a picture's size in pixels is needed")
    return int(value)


def _matrix(section: dict[str, Any], key: str, shape: tuple[int, int], path: Path) -> Float64Array:
    numbers = _numbers(section, key, path)
    if len(numbers) != shape[0] * shape[1]:
        raise CalibrationError(
            f"{path}: {key} has {len(numbers)} numbers; {shape[0]} x {shape[1]} are needed"
        )
    return numbers.reshape(shape)


def _numbers(section: dict[str, Any], key: str, path: Path) -> Float64Array:
    """Return the flat data of a matrix, in camera_info's form or as plain nested lists."""
    if key not in section:
        raise CalibrationError(f"{path}: {key} is missing")
    value = section[key]
    if isinstance(value, dict):
        if "data" not in value:
            raise CalibrationError(f"{path}: {key} has no data")
        value = value["data"]
    return _array(value, key, path).reshape(-1)


def _array(value: ArrayLike, key: str, path: Path) -> Float64Array:
    try:
        if isinstance(value, bool | str) or value is None:
            raise TypeError
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {key} is {value!r}, not a number") from error
    if numbers.size == 0 or not np.all(np.isfinite(numbers)):
        raise CalibrationError(f"{path}: {key} holds a number that is not finite")
    return numbers
