"""Detection of calibration targets: chessboards and ArUco markers."""

from __future__ import annotations

import re

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.errors import CalibrationError

# Error of a refined crossing on a board in focus, one sigma; the fit scales it where it is larger.
CHESSBOARD_SIGMA_PIXELS = 0.1
_REFINED_TO_PIXELS = 1e-3


def find_chessboard(
    image: UInt8Array, columns: int, rows: int, side_metres: float
) -> tuple[Float64Array, Float64Array]:
    """Return the inner corners of a chessboard on the floor and where they are seen.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR
    columns, rows : int
        Inner corners along the board's two sides.
    side_metres : float
        Of one field.

    Returns
    -------
    target : (N, 2) float64, metres
        In the board's axes, right-handed seen from above.
    pixels : (N, 2) float64

    Raises
    ------
    CalibrationError
        When the board is not found whole.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCornersSB(gray, (columns, rows), flags=flags)
    if not found:
        raise CalibrationError(
            f"no chessboard with {columns}x{rows} inner corners found in the photo; count only the "
            "corners where four fields meet, and keep the whole board in view"
        )
    pixels = _refine_crossings(
        np.asarray(gray, np.uint8), np.asarray(corners, np.float32).reshape(rows, columns, 2)
    )
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    target = side_metres * np.column_stack([column.ravel(), -row.ravel()]).astype(np.float64)
    grid = pixels.reshape(rows, columns, 2)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        target[:, 1] *= -1.0
    return target, pixels


def _refine_crossings(gray: UInt8Array, grid: Float32Array) -> Float64Array:
    """Refine (rows, columns, 2) crossings to where the gradients around them are consistent.

    The detector (Duda and Frese, BMVC 2018) leaves about half a pixel on the flat fields of a board
    seen from a slant; Foerstner's condition in a window of a third of a field does not.
    """
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    reach = max(2, int(min(steps) / 3))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, _REFINED_TO_PIXELS)
    start = np.ascontiguousarray(grid.reshape(-1, 1, 2), dtype=np.float32)
    refined = cv2.cornerSubPix(gray, start, (reach, reach), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def find_marker(image: UInt8Array, dictionary: str) -> tuple[Float64Array, int]:
    """Return the corners of an ArUco marker on the floor, and its number.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR
    dictionary : str
        Such as ``4x4_50`` or ``apriltag_36h11``.

    Returns
    -------
    corners : (4, 2) float64
        Pixels, of the black square; of the largest marker where there are several.
    number : int

    Raises
    ------
    CalibrationError
        When the dictionary is unknown or no such marker is seen.
    """
    known = {
        name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name)
        for name in dir(cv2.aruco)
        if re.match(r"DICT_\w+$", name)
    }
    if dictionary.lower() not in known:
        raise CalibrationError(
            f"--aruco {dictionary!r}: no such dictionary; choose one of {', '.join(known)}"
        )
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(known[dictionary.lower()]))
    found, numbers, _ = detector.detectMarkers(gray)
    if not found:
        raise CalibrationError(
            f"no ArUco marker of dictionary {dictionary} found in the photo; leave a white margin "
            "around it, or give its corners with --corners"
        )
    markers = [np.asarray(marker, dtype=np.float64).reshape(4, 2) for marker in found]
    areas = [cv2.contourArea(marker.astype(np.float32)) for marker in markers]
    largest = int(np.argmax(areas))
    return markers[largest], int(np.asarray(numbers).ravel()[largest])
