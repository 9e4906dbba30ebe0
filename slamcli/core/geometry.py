"""Geometry in the plane: poses, homographies, and metric pixel grids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array


def wrap_angle(angle_radians: float) -> float:
    """Return the angle brought into [-pi, pi)."""
    return (angle_radians + math.pi) % math.tau - math.pi


def invert(matrix: Float64Array) -> Float64Array:
    """Return the inverse of a square matrix; raises numpy's LinAlgError when it is singular."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def apply_homography(b_from_a: Float64Array, points: ArrayLike) -> Float64Array:
    """Map points through a plane projective transform.

    Parameters
    ----------
    b_from_a : (3, 3) array
    points : (..., 2) array, in a

    Returns
    -------
    (..., 2) array, in b. Points on the line at infinity come out as inf or nan, without a warning.
    """
    coordinates = np.asarray(points, dtype=np.float64)
    # A coordinate to a row: numpy is slow along an axis so short.
    rows = coordinates.reshape(-1, 2).T
    if b_from_a[2, 0] == 0.0 == b_from_a[2, 1] and b_from_a[2, 2] == 1.0:
        mapped = b_from_a[:2, :2] @ rows
        mapped += b_from_a[:2, 2:]
    else:
        scaled = b_from_a[:, :2] @ rows
        scaled += b_from_a[:, 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            mapped = scaled[:2] / scaled[2]
    return mapped.T.reshape(coordinates.shape)


@dataclass(frozen=True, slots=True)
class Pose2:
    """A rigid motion in the plane, ``a_from_b``: where frame b's origin and axes lie in frame a.

    Attributes
    ----------
    x, y : float
        Metres (pixels for a camera that looks straight down and has no calibration).
    theta : float
        Radians, counter-clockwise, in [-pi, pi).
    """

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", wrap_angle(self.theta))

    def __matmul__(self, other: Pose2) -> Pose2:
        """Return ``a_from_c`` for ``a_from_b @ b_from_c``."""
        cosine, sine = math.cos(self.theta), math.sin(self.theta)
        return Pose2(
            self.x + cosine * other.x - sine * other.y,
            self.y + sine * other.x + cosine * other.y,
            self.theta + other.theta,
        )

    def inverse(self) -> Pose2:
        """Return ``b_from_a``."""
        cosine, sine = math.cos(self.theta), math.sin(self.theta)
        return Pose2(
            -cosine * self.x - sine * self.y,
            sine * self.x - cosine * self.y,
            -self.theta,
        )

    @property
    def matrix(self) -> Float64Array:
        """The motion as a (3, 3) homogeneous matrix."""
        cosine, sine = math.cos(self.theta), math.sin(self.theta)
        return np.array([[cosine, -sine, self.x], [sine, cosine, self.y], [0.0, 0.0, 1.0]])

    @property
    def translation_length(self) -> float:
        """The distance between the two origins, in metres."""
        return math.hypot(self.x, self.y)

    @classmethod
    def from_matrix(cls, matrix: Float64Array) -> Self:
        """Return the pose of a (3, 3) matrix whose upper left block is a rotation."""
        return cls(
            float(matrix[0, 2]),
            float(matrix[1, 2]),
            math.atan2(float(matrix[1, 0]), float(matrix[0, 0])),
        )

    def apply(self, points: ArrayLike) -> Float64Array:
        """Map (..., 2) points in b to (..., 2) points in a, both in metres."""
        return apply_homography(self.matrix, points)


@dataclass(frozen=True, slots=True)
class Grid:
    """A raster laid over a metric plane: x to the right, y up, as a map is read.

    The half pixel between a pixel's centre (OpenCV's integer coordinate) and its corner lives
    here and nowhere else.

    Attributes
    ----------
    x_min, y_max : float
        Metres; the outer corner of the upper left pixel.
    metres_per_pixel : float
    width, height : int
        Pixels.
    """

    x_min: float
    y_max: float
    metres_per_pixel: float
    width: int
    height: int

    @classmethod
    def covering(cls, points: ArrayLike, metres_per_pixel: float) -> Self:
        """Return the smallest grid, corners on whole pixels, over (N, 2) points in metres."""
        coordinates = np.asarray(points, dtype=np.float64)
        x_low, y_low = np.floor(coordinates.min(axis=0) / metres_per_pixel)
        x_high, y_high = np.ceil(coordinates.max(axis=0) / metres_per_pixel)
        return cls(
            float(x_low) * metres_per_pixel,
            float(y_high) * metres_per_pixel,
            metres_per_pixel,
            max(1, int(x_high - x_low)),
            max(1, int(y_high - y_low)),
        )

    @property
    def halved(self) -> Grid:
        """The grid of every other pixel of every other row, the first ones among them."""
        half = 0.5 * self.metres_per_pixel
        return Grid(
            self.x_min - half,
            self.y_max + half,
            2.0 * self.metres_per_pixel,
            -(-self.width // 2),
            -(-self.height // 2),
        )

    @property
    def x_max(self) -> float:
        """Metres; the outer edge of the last column."""
        return self.x_min + self.width * self.metres_per_pixel

    @property
    def y_min(self) -> float:
        """Metres; the outer edge of the last row."""
        return self.y_max - self.height * self.metres_per_pixel

    @property
    def metres_from_pixel(self) -> Float64Array:
        """(3, 3): pixel centre (column, row) to metres (x, y)."""
        scale = self.metres_per_pixel
        return np.array(
            [
                [scale, 0.0, self.x_min + 0.5 * scale],
                [0.0, -scale, self.y_max - 0.5 * scale],
                [0.0, 0.0, 1.0],
            ]
        )

    @property
    def metres_from_corner(self) -> Float64Array:
        """(3, 3): as `metres_from_pixel`, but whole numbers at pixels' upper left corners."""
        scale = self.metres_per_pixel
        return np.array([[scale, 0.0, self.x_min], [0.0, -scale, self.y_max], [0.0, 0.0, 1.0]])

    @property
    def pixel_from_metres(self) -> Float64Array:
        """(3, 3): metres (x, y) to pixel (column, row), whole numbers at pixel centres."""
        scale = 1.0 / self.metres_per_pixel
        return np.array(
            [
                [scale, 0.0, -self.x_min * scale - 0.5],
                [0.0, -scale, self.y_max * scale - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )

    @property
    def corners(self) -> Float64Array:
        """(4, 2) metres: lower left, lower right, upper right, upper left outer corner."""
        return np.array(
            [
                [self.x_min, self.y_min],
                [self.x_max, self.y_min],
                [self.x_max, self.y_max],
                [self.x_min, self.y_max],
            ]
        )

    def window(self, column: int, row: int, width: int, height: int) -> Grid:
        """Return the part that starts at (column, row) and spans width x height pixels."""
        return Grid(
            self.x_min + column * self.metres_per_pixel,
            self.y_max - row * self.metres_per_pixel,
            self.metres_per_pixel,
            width,
            height,
        )


def pose_array(poses: Sequence[Pose2]) -> Float64Array:
    """Return poses as (N, 3): x, y (m), theta (rad)."""
    return np.array([(pose.x, pose.y, pose.theta) for pose in poses], np.float64).reshape(-1, 3)


def compose_poses(a_from_b: ArrayLike, b_from_c: ArrayLike) -> Float64Array:
    """Return ``a_from_c`` of (..., 3) poses x, y, theta, row by row; theta in [-pi, pi)."""
    first = np.asarray(a_from_b, dtype=np.float64)
    second = np.asarray(b_from_c, dtype=np.float64)
    cosine, sine = np.cos(first[..., 2]), np.sin(first[..., 2])
    x = first[..., 0] + cosine * second[..., 0] - sine * second[..., 1]
    y = first[..., 1] + sine * second[..., 0] + cosine * second[..., 1]
    theta = (first[..., 2] + second[..., 2] + math.pi) % math.tau - math.pi
    return np.stack([x, y, theta], axis=-1)


def relative_poses(c_from_a: ArrayLike, c_from_b: ArrayLike) -> Float64Array:
    """Return ``a_from_b`` of (..., 3) poses x, y, theta, row by row; theta in [-pi, pi)."""
    first = np.asarray(c_from_a, dtype=np.float64)
    second = np.asarray(c_from_b, dtype=np.float64)
    cosine, sine = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = second[..., 0] - first[..., 0], second[..., 1] - first[..., 1]
    theta = (second[..., 2] - first[..., 2] + math.pi) % math.tau - math.pi
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, theta], axis=-1)


def covariance_in_map(map_from_robot: Pose2, covariance: Float64Array) -> Float64Array:
    """Return a pose's (3, 3) covariance, given in the robot's own axes, in those of the map."""
    turn = np.eye(3)
    turn[:2, :2] = map_from_robot.matrix[:2, :2]
    turned: Float64Array = turn @ covariance @ turn.T
    return turned


def squared_mahalanobis(expected: Pose2, covariance: Float64Array, pose: Pose2) -> float:
    """Return the distance of a pose from an expected one, with its (3, 3) covariance, squared."""
    error = expected.inverse() @ pose
    vector = np.array([error.x, error.y, error.theta])
    return float(vector @ invert(covariance) @ vector)


def path_length(poses: Sequence[Pose2]) -> float:
    """Return the sum of the distances between consecutive poses, in metres."""
    if len(poses) < 2:
        return 0.0
    positions = np.array([(pose.x, pose.y) for pose in poses])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
