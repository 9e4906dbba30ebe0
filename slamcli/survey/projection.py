"""Projection of the plane into cameras with six degrees of freedom, with its derivatives.

A frame's state is where the floor point in its picture's middle lies on the map, the direction of
the picture's right there, its scale, and its tilt: ``x, y, yaw, log scale, pitch, roll``. Without
tilt a pixel of the picture is ``scale`` units of the map. Unlike pitch and roll below the horizon,
this has no singularity at a camera that looks straight down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array

STATES = 6
X, Y, YAW, LOG_SCALE, PITCH, ROLL = range(STATES)
_UNDISTORTION_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Projections:
    """Homographies of N frames.

    Attributes
    ----------
    image_from_map : (N, 3, 3) float64
        To undistorted pixels from the picture's middle.
    by_state : (N, 6, 3, 3) float64
        Derivatives by each number of the frame's state.
    by_log_focal : (N, 3, 3) float64
    """

    image_from_map: Float64Array
    by_state: Float64Array
    by_log_focal: Float64Array


def project(
    states: Float64Array, focal_pixels: float, camera_from_nadir: Float64Array | None = None
) -> Projections:
    """Return the homographies of (N, 6) states.

    Parameters
    ----------
    states : (N, 6) float64
    focal_pixels : float
    camera_from_nadir : (3, 3) float64 or None
        Of a camera that looks ahead: to its pixels from those of one that looks straight down from
        the same place, which the states are of.

    The image of a floor point is ``K [r1 r2 (0, 0, d)] map_from_robot^-1`` with depth ``d = scale
    f`` of the picture's middle (Hartley and Zisserman, Multiple View Geometry, 8.1), here divided
    by f in rows one and two.
    """
    x, y, yaw, log_scale, pitch, roll = states.T
    zero, one = np.zeros(len(states)), np.ones(len(states))

    def stack(*rows: tuple[Float64Array, Float64Array, Float64Array]) -> Float64Array:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    cos, sin = np.cos(yaw), np.sin(yaw)
    right, up = cos * x + sin * y, sin * x - cos * y
    robot_from_map = stack((cos, sin, -right), (-sin, cos, up), (zero, zero, one))
    by_x = stack((zero, zero, -cos), (zero, zero, sin), (zero, zero, zero))
    by_y = stack((zero, zero, -sin), (zero, zero, -cos), (zero, zero, zero))
    by_yaw = stack((-sin, cos, up), (-cos, -sin, right), (zero, zero, zero))
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    scale, f = np.exp(log_scale), focal_pixels
    nothing = (zero, zero, zero)
    image = stack((cr, -sr * sp, zero), (zero, -cp, zero), (-sr / f, -cr * sp / f, scale))
    by_scale = stack(nothing, nothing, (zero, zero, scale))
    by_pitch = stack((zero, -sr * cp, zero), (zero, sp, zero), (zero, -cr * cp / f, zero))
    by_roll = stack((-sr, -cr * sp, zero), nothing, (-cr / f, sr * sp / f, zero))
    by_focal = stack(nothing, nothing, (sr / f, cr * sp / f, zero))
    of_map = [image @ by for by in (by_x, by_y, by_yaw)]
    of_image = [by @ robot_from_map for by in (by_scale, by_pitch, by_roll)]
    by_state = np.stack([*of_map, *of_image], axis=1)
    turn = np.eye(3) if camera_from_nadir is None else camera_from_nadir
    return Projections(
        turn @ image @ robot_from_map, turn @ by_state, turn @ by_focal @ robot_from_map
    )


def undistort(
    pixels: Float64Array, bend: float, radius_pixels: float
) -> tuple[Float64Array, Float64Array]:
    """Return undistorted pixels, and their derivatives by the bend, (N, 2) each.

    Parameters
    ----------
    pixels : (N, 2) float64
        Distorted: ``u (1 + bend |u / radius|^2)`` of undistorted u, all from the picture's middle.
    """
    there = np.linalg.norm(pixels, axis=1) / radius_pixels
    radius = there.copy()
    for _ in range(_UNDISTORTION_STEPS):
        slope = 1.0 + 3.0 * bend * radius**2
        radius = radius - (radius * (1.0 + bend * radius**2) - there) / slope
    undistorted = pixels / (1.0 + bend * radius**2)[:, None]
    slope = 1.0 + 3.0 * bend * radius**2
    return undistorted, -undistorted * (radius**2 / slope)[:, None]
