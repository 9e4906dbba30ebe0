"""Detection of calibration targets: chessboards and ArUco markers."""

from __future__ import annotations

import re

import cv2
import numpy as np
from scipy.linalg import block_diag

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.errors import CalibrationError
from slamcli.core.light import Gamma, light_of_image
from slamcli.stages.calibrate.crossings import refine_crossings

_REFINED_TO_PIXELS = 1e-3


def find_chessboard(
    image: UInt8Array, columns: int, rows: int, side_metres: float, gamma: Gamma = "srgb"
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the inner corners of a chessboard on the floor, where they are seen, and how certain.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR
    columns, rows : int
        Inner corners along the board's two sides.
    side_metres : float
        Of one field.
    gamma : Gamma
        How the picture's values encode light.

    Returns
    -------
    target : (N, 2) float64, metres
        In the board's axes, right-handed seen from above.
    pixels : (N, 2) float64
    covariance : (2N, 2N) float64
        Of the pixels (x0, y0, x1, ...).

    Raises
    ------
    CalibrationError
        When the board is not found whole.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    corners = _detect(np.asarray(gray, np.uint8), columns, rows)
    if corners is None:
        if _detect(np.asarray(gray, np.uint8), columns - 1, rows - 1) is not None:
            raise CalibrationError(
                f"the photo shows a chessboard of {columns}x{rows} fields; give its inner corners, "
                f"where four fields meet: --chessboard {columns - 1}x{rows - 1}"
            )
        raise CalibrationError(
            f"no chessboard with {columns}x{rows} inner corners found in the photo; count only the "
            "corners where four fields meet, and keep the whole board, with its white margin, in "
            "view"
        )
    light = np.asarray(cv2.cvtColor(light_of_image(image, gamma), cv2.COLOR_BGR2GRAY), np.float32)
    grid = _near_crossings(light, corners.reshape(rows, columns, 2))
    grid, covariances = refine_crossings(light, grid)
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    target = side_metres * np.column_stack([column.ravel(), -row.ravel()]).astype(np.float64)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        target[:, 1] *= -1.0
    covariance = block_diag(*covariances.reshape(-1, 2, 2))
    return target, grid.reshape(-1, 2), np.asarray(covariance, dtype=np.float64)


def _detect(gray: UInt8Array, columns: int, rows: int) -> Float32Array | None:
    """Return (rows * columns, 2) rough crossings by the first detector that finds the whole board.

    The older one finds boards of few pixels a field, the newer one (Duda and Frese, BMVC 2018)
    those that are blurred or unevenly lit.
    """
    size = (columns, rows)
    if min(size) < 3:
        return None
    found, corners = cv2.findChessboardCorners(gray, size)
    if not found:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(gray, size, flags=flags)
    return np.asarray(corners, np.float32).reshape(-1, 2) if found else None


def _near_crossings(light: Float32Array, grid: Float32Array) -> Float64Array:
    """Move (rows, columns, 2) crossings to where the gradients around them are consistent.

    The detectors leave up to half a pixel on the flat fields of a board seen from a slant;
    Foerstner's condition in a window of a third of a field leaves less.
    """
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    reach = max(2, int(min(steps) / 3))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, _REFINED_TO_PIXELS)
    start = np.ascontiguousarray(grid.reshape(-1, 1, 2), dtype=np.float32)
    refined = cv2.cornerSubPix(light, start, (reach, reach), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(grid.shape)


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
    found, numbers = _detect_markers(np.asarray(gray, np.uint8), known[dictionary.lower()])
    if not found:
        raise CalibrationError(
            f"no ArUco marker of dictionary {dictionary} found in the photo; leave a white margin "
            "around it, or give its corners with --corners"
        )
    areas = [cv2.contourArea(marker.astype(np.float32)) for marker in found]
    largest = int(np.argmax(areas))
    return found[largest], numbers[largest]


def _detect_markers(gray: UInt8Array, dictionary: int) -> tuple[list[Float64Array], list[int]]:
    """Return (4, 2) corners of markers, and their numbers.

    A small one shows in the enlarged picture; white on black ones are looked for last, as the white
    margin of a usual one may pass for such.
    """
    known = cv2.aruco.getPredefinedDictionary(dictionary)
    for inverted in (False, True):
        parameters = cv2.aruco.DetectorParameters()
        parameters.detectInvertedMarker = inverted
        detector = cv2.aruco.ArucoDetector(known, parameters)
        for enlarged in (1, 2):
            size = (enlarged * gray.shape[1], enlarged * gray.shape[0])
            picture = cv2.resize(gray, size, interpolation=cv2.INTER_LINEAR)
            found, numbers, _ = detector.detectMarkers(picture)
            if len(found):
                # The middle of the first pixel lies between the first two of the enlarged picture.
                corners = [np.asarray(marker, np.float64).reshape(4, 2) for marker in found]
                corners = [(marker - (enlarged - 1) / 2) / enlarged for marker in corners]
                return corners, [int(number) for number in np.asarray(numbers).ravel()]
    return [], []
