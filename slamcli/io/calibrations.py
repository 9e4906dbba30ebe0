"""calibration.yaml: a superset of ROS camera_info in YAML, with a comment on every unit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import quoted
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.errors import CalibrationError, InputError
from slamcli.io import calibration_codec
from slamcli.io.camera_info import intrinsics_section, matrix_data, number, read_document
from slamcli.io.checks import FieldError, check_array
from slamcli.io.containers.bag_readings import camera_info, has_readings
from slamcli.io.files import write_text

FORMAT_VERSION = 1
# What the fields of the codec are called in the file, where it is not the same.
_YAML_KEYS = {
    "image_size width": "image_width",
    "image_size height": "image_height",
    "distortion": "distortion_coefficients",
    "pitch_radians": "pitch_degrees, in radians,",
    "roll_radians": "roll_degrees, in radians,",
    "ahead_radians": "ahead_degrees, in radians,",
    "pitch_sigma_radians": "pitch_sigma_degrees, in radians,",
    "roll_sigma_radians": "roll_sigma_degrees, in radians,",
    "format_version": "ground_plane.format_version",
    "height_metres": "ground_plane.height_metres",
    "max_range_metres": "ground_plane.max_range_metres",
    "robot_from_image": "ground_plane.robot_from_image",
}


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationSource:
    """The photo and the target that a calibration was made from, noted in its file.

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

    ``ground_plane.robot_from_image`` may be left out; where it is given it must agree with the
    camera matrix, height, pitch and roll, from which the homography is always composed.

    Raises
    ------
    CalibrationError
        One line that names the file, the key and what is wrong with it.
    """
    path = Path(path)
    document = read_document(path, "calibration")
    ground = document.get("ground_plane")
    if not isinstance(ground, dict):
        raise CalibrationError(
            f"{path}: no ground_plane section: this file describes the lens but not where the "
            "camera is mounted; make one by slam calibrate PHOTO --intrinsics"
        )
    try:
        plain = {**intrinsics_section(document), **_mounting_section(ground)}
        if "robot_from_image" in ground:
            # Only checked: the numbers that it comes from may have more digits.
            given = matrix_data(ground, "robot_from_image")
            calibration_codec.from_dict({**plain, "robot_from_image": given})
        return calibration_codec.from_dict(plain)
    except FieldError as error:
        raise _named(error, path) from error


def load_origin(path: str | Path) -> CalibrationSource | None:
    """Return the photo and target noted in a calibration file; None where there are none.

    Raises
    ------
    CalibrationError
    """
    path = Path(path)
    ground = read_document(path, "calibration").get("ground_plane")
    made_from = ground.get("made_from") if isinstance(ground, dict) else None
    if not isinstance(made_from, dict) or not {"side_metres", "corners"} <= made_from.keys():
        return None
    try:
        return CalibrationSource(
            str(made_from.get("photo", "")),
            str(made_from.get("target", "")),
            number(made_from, "side_metres"),
            check_array(made_from["corners"], "made_from.corners").reshape(-1, 2),
        )
    except FieldError as error:
        raise _named(error, path) from error


def load_intrinsics(path: str | Path) -> Intrinsics:
    """Return the camera of a camera_info: a ROS file, a topic's echo, a bag, or OpenCV's.

    Raises
    ------
    CalibrationError
        One line that names the file, the key and what is wrong with it.
    """
    path = Path(path)
    try:
        bag = has_readings(path)
        document = camera_info(path) if bag else read_document(path, "camera_info")
    except InputError as error:
        raise CalibrationError(str(error)) from error
    try:
        return calibration_codec.intrinsics_from_dict(intrinsics_section(document))
    except FieldError as error:
        raise _named(error, path) from error


def save_calibration(
    path: Path, calibration: Calibration, origin: CalibrationSource | None = None
) -> None:
    """Write a calibration whole or not at all; `load_calibration` returns the same numbers.

    Raises
    ------
    CalibrationError
        When its numbers are none that `load_calibration` would accept.
    OutputError
    """
    try:
        calibration_codec.from_dict(calibration_codec.to_dict(calibration))
    except FieldError as error:
        raise _named(error, path) from error
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
            *_ahead_lines(calibration),
            f"  focal_sigma_pixels: {_text(calibration.focal_sigma_pixels)}",
            f"  height_sigma_metres: {_text(calibration.height_sigma_metres)}",
            f"  pitch_sigma_degrees: {_text(_degrees(calibration.pitch_sigma_radians))}",
            f"  roll_sigma_degrees: {_text(_degrees(calibration.roll_sigma_radians))}",
            *_covariance_lines(calibration.covariance),
            f"  max_range_metres: {_text(calibration.max_range_metres)}"
            "  # floor beyond this distance is not used",
            "  # Undistorted pixel (column, row, 1) to floor metres (x, y, 1), up to scale.",
            "  # It may be left out; change it together with the numbers above.",
            *_matrix_lines("robot_from_image", calibration.robot_from_image, indent="  "),
            *_origin_lines(origin),
            "",
        ]
    )


def _covariance_lines(covariance: Float64Array | None) -> list[str]:
    if covariance is None:
        return []
    return [
        "  # Of log focal length, log height, pitch and roll (radians), which err together.",
        *_matrix_lines("covariance", covariance, indent="  "),
    ]


def _ahead_lines(calibration: Calibration) -> list[str]:
    if math.isnan(calibration.ahead_radians):
        return []
    return [
        f"  ahead_degrees: {_text(_degrees(calibration.ahead_radians))}"
        "  # of the direction in the picture that is x, clockwise from up; roll turns about x",
    ]


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


def _mounting_section(ground: dict[str, Any]) -> dict[str, Any]:
    """Return a ground_plane section by the codec's names, angles in radians; raises FieldError."""
    version = ground.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise FieldError(
            "format_version", f"is {quoted(version)}; this slamcli reads {FORMAT_VERSION}"
        )
    return {
        "height_metres": number(ground, "height_metres"),
        "pitch_radians": math.radians(number(ground, "pitch_degrees")),
        "roll_radians": math.radians(number(ground, "roll_degrees")),
        "ahead_radians": math.radians(number(ground, "ahead_degrees", math.nan)),
        "max_range_metres": number(ground, "max_range_metres"),
        "focal_sigma_pixels": number(ground, "focal_sigma_pixels", math.nan),
        "height_sigma_metres": number(ground, "height_sigma_metres", math.nan),
        "pitch_sigma_radians": math.radians(number(ground, "pitch_sigma_degrees", math.nan)),
        "roll_sigma_radians": math.radians(number(ground, "roll_sigma_degrees", math.nan)),
        "covariance": None if "covariance" not in ground else matrix_data(ground, "covariance"),
    }


def _named(error: FieldError, path: Path) -> CalibrationError:
    """Return the error of a field with the file, and the key as the file has it."""
    return CalibrationError(f"{path}: {_YAML_KEYS.get(error.key, error.key)} {error.reason}")
