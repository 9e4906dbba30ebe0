"""Choice of the calibration square among the quadrilaterals of a photo."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.lens import Lens, distort_points, undistort_points
from slamcli.core.errors import CalibrationError
from slamcli.core.light import Gamma, light_of_image
from slamcli.stages.square.candidates import find_candidates, inner_radius, quad_area, same_quad
from slamcli.stages.square.edge_bias import correct_bias
from slamcli.stages.square.edges import EdgedQuad, refine_quad
from slamcli.stages.square.profiles import measure_step

# How well (4, 2) undistorted corners may be a square on the floor, in [0, 1].
Squareness = Callable[[Float64Array], float]

# Candidates are searched in a picture of this width.
_SEARCH_WIDTH_PIXELS = 960
_MAX_CANDIDATES = 40
# How far a candidate's sides may be from the edges, in pixels of that picture.
_REACH_PIXELS = 6.0
# Share of the edge profiles that must show the sides: saves scoring what the score would reject too
# (no test depends on its value).
_MIN_SUPPORT = 0.45
# Least score of a square [guarded by tests/stages/test_square.py].
_MIN_SCORE = 0.03
# A second square that scores this share of the first is reported.
_RUNNER_UP_SHARE = 0.5
_MIN_RADIUS_PIXELS = 4.0
# Beyond these more contrast, or a larger share of the picture, does not raise the score.
_FULL_CONTRAST_GRAY = 40.0
_FULL_SHARE = 0.1
_COLOURED_GRAY_LEVELS = 25.0
# The luminance has less noise than its channels: one of these must show so much more of a step.
_LUMINANCE_GAIN = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Square:
    """Result of the square detection.

    Attributes
    ----------
    corners : (4, 2) float64
        Pixels of the picture itself, clockwise from the upper left.
    quad : EdgedQuad
        The same, undistorted, with its covariance; its corners are in the same order.
    score : float
        In [0, 1]: how well it is seen, how large it is, how plausible it is.
    """

    corners: Float64Array
    quad: EdgedQuad
    score: float


def find_squares(
    image: UInt8Array, lens: Lens, squareness: Squareness, gamma: Gamma = "srgb"
) -> tuple[Square, ...]:
    """Return the square that is best supported, and any other that comes near it, best first.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR
    lens : Lens
        Its distortion, to fit straight sides; the camera matrix may be a guess where that is zero.
    squareness : callable
        How well undistorted corners may be a square on the floor, in [0, 1].
    gamma : Gamma
        How the picture's values encode light.

    Raises
    ------
    CalibrationError
        When no quadrilateral in the picture can be the square.
    """
    planes = _planes(image, gamma)
    for plane, exact in planes:
        found = _squares_in(plane, exact, lens, squareness)
        if found:
            return tuple(
                _finished(square, planes, lens, gamma)
                for square in found
                if square.score >= _RUNNER_UP_SHARE * found[0].score
            )
    raise CalibrationError(
        "no square found on the floor in the photo; give its four corners with "
        '--corners "x,y x,y x,y x,y", or name what lies there with --chessboard or --aruco'
    )


def _planes(image: UInt8Array, gamma: Gamma) -> list[tuple[UInt8Array, Float32Array]]:
    """Return the luminance, and of a coloured picture its channels, as codes and as light."""
    light = light_of_image(image, gamma)
    luminance = np.asarray(cv2.cvtColor(light, cv2.COLOR_BGR2GRAY), np.float32)
    planes = [(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8), luminance)]
    if _is_coloured(image):
        # A square of another colour but like luminance shows in at least one of the channels.
        planes += [
            (np.ascontiguousarray(image[..., channel]), np.ascontiguousarray(light[..., channel]))
            for channel in (2, 1, 0)
        ]
    return planes


def refine_square(
    image: UInt8Array, corners: Float64Array, lens: Lens, gamma: Gamma = "srgb"
) -> Square:
    """Return the square whose corners were given, moved to the edges of the picture nearby.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR
    corners : (4, 2)
        Pixels of the picture, clockwise, within about three pixels of the truth.
    lens : Lens
    gamma : Gamma
        How the picture's values encode light.

    Raises
    ------
    CalibrationError
        When a side shows no edge there.
    """
    undistorted = undistort_points(lens, corners)
    planes = _planes(image, gamma)
    quad = refine_quad(planes[0][1], undistorted, lens, 4.0)
    if quad is None:
        raise CalibrationError(
            "no edges found along the sides between the given corners; check --corners, or leave "
            "out --refine to use them as they are"
        )
    found = Square(distort_points(lens, quad.corners), quad, quad.support)
    return _finished(found, planes, lens, gamma)


def _finished(
    square: Square, planes: list[tuple[UInt8Array, Float32Array]], lens: Lens, gamma: Gamma
) -> Square:
    """Return the square as the plane that shows it best has it, without the camera's bias."""
    found, corners = square.quad, square.quad.corners
    steps = [
        abs(measure_step(plane.astype(np.float32), corners, lens, _REACH_PIXELS))
        for plane, _ in planes
    ]
    best = int(np.argmax([steps[0] * _LUMINANCE_GAIN, *steps[1:]]))
    if best > 0:
        found = refine_quad(planes[best][1], corners, lens, _REACH_PIXELS) or found
    plane = planes[best][0].astype(np.float32)
    quad = correct_bias(plane, found, lens, gamma)
    return Square(distort_points(lens, quad.corners), quad, square.score)


def _squares_in(
    plane: UInt8Array, exact: Float32Array, lens: Lens, squareness: Squareness
) -> list[Square]:
    height, width = plane.shape
    shrink = max(1.0, width / _SEARCH_WIDTH_PIXELS)
    small = plane
    if shrink > 1.0:
        size = (round(width / shrink), round(height / shrink))
        small = np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    quads, supports = find_candidates(small, _MAX_CANDIDATES)
    codes = plane.astype(np.float32)
    found: list[Square] = []
    for quad, support in zip(_enlarge(quads, shrink), supports, strict=True):
        undistorted = undistort_points(lens, quad)
        if support < _MIN_SUPPORT or inner_radius(undistorted) < _MIN_RADIUS_PIXELS:
            continue
        edged = refine_quad(exact, undistorted, lens, _REACH_PIXELS * shrink)
        if edged is None or edged.support < _MIN_SUPPORT:
            continue
        corners = distort_points(lens, edged.corners)
        if np.any(corners < 0) or np.any(corners > (width - 1, height - 1)):
            continue
        contrast = measure_step(codes, edged.corners, lens, _REACH_PIXELS * shrink)
        score = _score(edged, contrast, width * height, squareness)
        if score >= _MIN_SCORE:
            found.append(_from_upper_left(corners, edged, score))
    return _distinct(found)


def _is_coloured(image: UInt8Array) -> bool:
    """Return whether some part of the picture, beyond its noise, is not gray."""
    small = cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA).astype(np.float64)
    return float(np.ptp(small, axis=2).max()) > _COLOURED_GRAY_LEVELS


def _score(quad: EdgedQuad, contrast: float, picture_area: int, squareness: Squareness) -> float:
    """Return the product of a quadrilateral's support, contrast, size and squareness, in [0, 1].

    Contrast is in gray levels, as the eye and the encoded picture have them.

    Size counts, as the larger of two similar squares determines the camera better.
    """
    share = float(quad_area(quad.corners)) / picture_area
    size = min(1.0, (share / _FULL_SHARE) ** 0.4)
    full = min(1.0, abs(contrast) / _FULL_CONTRAST_GRAY)
    score: float = quad.support**2 * full * size * squareness(quad.corners)
    return score


def _enlarge(quads: Float64Array, factor: float) -> Float64Array:
    """Map pixels of a picture shrunk by area averaging to those of the whole one."""
    # The middle of the first small pixel lies in the middle of the first `factor` large ones.
    enlarged: Float64Array = quads * factor + (factor - 1.0) / 2.0
    return enlarged


def _from_upper_left(corners: Float64Array, quad: EdgedQuad, score: float) -> Square:
    turn = -int(np.argmin(corners.sum(axis=1)))
    turned = EdgedQuad(
        corners=np.roll(quad.corners, turn, axis=0),
        covariance=np.roll(quad.covariance, (2 * turn, 2 * turn), axis=(0, 1)),
        support=quad.support,
        bow_pixels=quad.bow_pixels,
        residual_pixels=quad.residual_pixels,
        sides=quad.sides[-turn % 4 :] + quad.sides[: -turn % 4],
    )
    return Square(np.roll(corners, turn, axis=0), turned, score)


def _distinct(squares: list[Square]) -> list[Square]:
    """Sort, best first, and drop those that are the same as a better one."""
    kept: list[Square] = []
    for square in sorted(squares, key=lambda square: -square.score):
        others = np.array([other.corners for other in kept]).reshape(-1, 4, 2)
        if not math.isfinite(square.score) or same_quad(square.corners, others).any():
            continue
        kept.append(square)
    return kept
