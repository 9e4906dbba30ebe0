"""Joint photometric alignment of consecutive pictures of a floor with the camera that took them.

Pixels of strong gradient in each picture are transferred through the floor to the others, where
they should find the same detail; focal length, pitch, roll, radial distortion and all motions are
the unknowns (direct alignment: Lucas and Kanade, IJCAI 1981). The camera's height is the unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.stages.dense.pyramid import sample
from slamcli.survey.oblique_camera import (
    BEND_PRIOR_SIGMA,
    FOCAL_PRIOR_SIGMA,
    ROLL_PRIOR_SIGMA,
    distorted,
    undistorted,
)

LOG_FOCAL, PITCH, ROLL, BEND = range(4)
CAMERA = 4
_PRIOR_SIGMAS = np.array([FOCAL_PRIOR_SIGMA, ROLL_PRIOR_SIGMA, BEND_PRIOR_SIGMA])
_MAX_POINTS, _BORDER_PIXELS, _BEHIND_PIXELS = 500, 2, 1e4
# Of rows of points: the derivative of a turn by its angle.
_QUARTER_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
_DIFFERENCE, _MIN_SHARED_POINTS = 1e-5, 30
# A step of a search that diverges is not followed beyond a focal length of so many widths.
_MAX_LOG_FOCAL = math.log(100.0)
# Errors of neighbouring pixels along an edge are one error: so many points count as one.
_DEPENDENT_POINTS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Result of an alignment.

    Attributes
    ----------
    values : (4 + 3 (N - 1),) float64
        Log focal length in widths, pitch, roll, k1; then x, y, heading of each picture but the
        first, in its frame.
    correlations : (P,) float64
        Of each pair's details where both are seen, in the worse of its two directions.
    sigmas : (4,) float64
        Of the camera's numbers.
    """

    values: Float64Array
    correlations: Float64Array
    sigmas: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Template:
    """The points of one picture that are looked for in the others."""

    pixels: Float64Array
    values: Float64Array


class Alignment:
    """The alignment of pictures of one size, of local detail, as a least-squares problem."""

    def __init__(self, details: Sequence[Float32Array], pairs: Sequence[tuple[int, int]]) -> None:
        self.details = [one / np.float32(max(float(one.std()), 1e-6)) for one in details]
        self.pairs = pairs
        height, width = details[0].shape
        self.width, self.size = width, np.array([width, height])
        self.centre = np.array(image_centre((width, height)))
        self.slopes = [
            [
                np.asarray(cv2.Scharr(one, cv2.CV_32F, *order, scale=1 / 32), np.float32)
                for order in ((1, 0), (0, 1))
            ]
            for one in self.details
        ]
        both = zip(self.details, self.slopes, strict=True)
        self.templates = [self._template(*one) for one in both]
        self.directed = [two for a, b in pairs for two in ((a, b), (b, a))]

    def solve(self, start: Float64Array, steps: int) -> Aligned:
        """Return the alignment from a first guess."""
        # Slow to load, and needed for cameras without a calibration alone.
        from scipy.optimize import least_squares

        found = least_squares(
            self._misfit, start, self._jacobian, loss="soft_l1", x_scale="jac", max_nfev=steps
        )
        values = np.asarray(found.x, np.float64)
        jacobian = np.asarray(found.jac, np.float64)
        noise = 2.0 * float(found.cost) / len(jacobian)
        covariance = _DEPENDENT_POINTS * noise * np.linalg.pinv(jacobian.T @ jacobian)
        both = np.array([self._correlation(values, a, b) for a, b in self.directed])
        variances = np.diag(covariance)[:CAMERA]
        # What pictures without a motion leave open comes out as 0 or below.
        sigmas = np.sqrt(np.where(variances > 0.0, variances, np.inf))
        return Aligned(values, both.reshape(-1, 2).min(axis=1), sigmas)

    def _template(self, detail: Float32Array, slopes: Sequence[Float32Array]) -> _Template:
        strength = np.zeros_like(detail)
        inner = slice(_BORDER_PIXELS, -_BORDER_PIXELS)
        strength[inner, inner] = (slopes[0] ** 2 + slopes[1] ** 2)[inner, inner]
        count = min(4 * _MAX_POINTS, strength.size // 2)
        strongest = np.sort(np.argpartition(-strength.ravel(), count)[:count])
        chosen = strongest[:: max(1, count // _MAX_POINTS)]
        rows, columns = np.unravel_index(chosen, detail.shape)
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        return _Template(pixels, detail.ravel()[chosen].astype(np.float64))

    def _misfit(self, values: Float64Array) -> Float64Array:
        lens, poses = _Lens(values[:CAMERA], self.width), _poses(values)
        prior = values[[LOG_FOCAL, ROLL, BEND]] / _PRIOR_SIGMAS
        found = [
            sample(self.details[b], self._transferred(lens, poses, a, b)) - self.templates[a].values
            for a, b in self.directed
        ]
        return np.concatenate([*found, prior])

    def _transferred(self, lens: _Lens, poses: list[Pose2], a: int, b: int) -> Float64Array:
        """Return (N, 2) pixels of picture b where the points of a's template lie."""
        floor = lens.floor(self.templates[a].pixels - self.centre)
        found = lens.pixels((poses[b].inverse() @ poses[a]).apply(floor)) + self.centre
        return np.asarray(found, np.float64)

    def _jacobian(self, values: Float64Array) -> Float64Array:
        """Return the derivatives: of the geometry by differences, of the pictures by slopes."""
        lens, poses = _Lens(values[:CAMERA], self.width), _poses(values)
        changed_lenses = [
            _Lens(values[:CAMERA] + _DIFFERENCE * unit, self.width) for unit in np.eye(CAMERA)
        ]
        blocks = []
        for a, b in self.directed:
            floor = lens.floor(self.templates[a].pixels - self.centre)
            b_from_a = poses[b].inverse() @ poses[a]
            moved = b_from_a.apply(floor)
            here = lens.pixels(moved)
            slopes = np.column_stack([sample(one, here + self.centre) for one in self.slopes[b]])
            block = np.zeros((len(here), len(values)))
            for column, changed in enumerate(changed_lenses):
                there = self._transferred(changed, poses, a, b) - self.centre
                block[:, column] = np.sum(slopes * (there - here), axis=1) / _DIFFERENCE
            by_floor = [
                np.sum(slopes * (lens.pixels(moved + _DIFFERENCE * unit) - here), axis=1)
                for unit in np.eye(2)
            ]
            by_moved = np.column_stack(by_floor) / _DIFFERENCE
            # Derivatives are 0 above the horizon, where there is no floor.
            floor, moved = np.nan_to_num(floor), np.nan_to_num(moved)
            # Shifts turn with the frame of b; turns are about the origin of either frame.
            turn = poses[b].matrix[:2, :2]
            by_shift = by_moved @ turn.T
            if a:
                block[:, _columns(a)[:2]] = by_shift
                around = (poses[a].apply(floor) - poses[a].matrix[:2, 2]) @ _QUARTER_TURN
                block[:, _columns(a)[2]] = np.sum(by_shift * around, axis=1)
            if b:
                block[:, _columns(b)[:2]] = -by_shift
                block[:, _columns(b)[2]] = -np.sum(by_moved * (moved @ _QUARTER_TURN), axis=1)
            blocks.append(block)
        prior = np.zeros((3, len(values)))
        prior[range(3), [LOG_FOCAL, ROLL, BEND]] = 1.0 / _PRIOR_SIGMAS
        return np.vstack([*blocks, prior])

    def _correlation(self, values: Float64Array, a: int, b: int) -> float:
        lens = _Lens(values[:CAMERA], self.width)
        pixels = self._transferred(lens, _poses(values), a, b)
        inside: BoolArray = np.all((pixels > 0) & (pixels < self.size - 1), axis=1)
        if inside.sum() < _MIN_SHARED_POINTS:
            return 0.0
        first, second = self.templates[a].values[inside], sample(self.details[b], pixels[inside])
        if min(first.std(), second.std()) < 1e-9:
            return 0.0
        return float(np.corrcoef(first, second)[0, 1])


class _Lens:
    """The projection between the floor, in heights of the camera, and pixels from the middle."""

    def __init__(self, camera: Float64Array, width: int) -> None:
        log_focal = min(max(float(camera[LOG_FOCAL]), -_MAX_LOG_FOCAL), _MAX_LOG_FOCAL)
        self.focal, self.bend = width * math.exp(log_focal), float(camera[BEND])
        matrix = np.diag([self.focal, self.focal, 1.0])
        tilt = float(camera[PITCH]), float(camera[ROLL])
        self.image_from_floor = image_from_robot_homography(matrix, 1.0, *tilt)
        self.floor_from_image = invert(self.image_from_floor)

    def floor(self, pixels: Float64Array) -> Float64Array:
        """Return (N, 2) points of the floor; nan above the horizon."""
        seen = undistorted(pixels, self.bend, self.focal)
        return _in_front(self.floor_from_image, seen)

    def pixels(self, floor: Float64Array) -> Float64Array:
        """Return (N, 2) pixels; far away for what is behind the camera or nan."""
        found = distorted(_in_front(self.image_from_floor, floor), self.bend, self.focal)
        found = np.nan_to_num(found, nan=-_BEHIND_PIXELS)
        return np.asarray(np.clip(found, -_BEHIND_PIXELS, _BEHIND_PIXELS), np.float64)


def _in_front(homography: Float64Array, points: Float64Array) -> Float64Array:
    depth = points @ homography[2, :2] + homography[2, 2]
    mapped = apply_homography(homography, np.where(depth[:, None] > 1e-6, points, np.nan))
    return np.asarray(mapped, np.float64)


def _columns(number: int) -> list[int]:
    """Return the columns of a picture's x, y and heading."""
    first = CAMERA + 3 * (number - 1)
    return [first, first + 1, first + 2]


def _poses(values: Float64Array) -> list[Pose2]:
    return [Pose2(), *(Pose2(*row) for row in values[CAMERA:].reshape(-1, 3).tolist())]
