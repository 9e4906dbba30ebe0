"""The factors of each kind as arrays, with their residuals and Jacobians."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import compose_poses, relative_poses
from slamcli.stages.posegraph.state import GraphState


class Jacobians(NamedTuple):
    """Derivatives of the residuals of K factors by the variables that each depends on.

    Attributes
    ----------
    variables : tuple of (K, d) int64
        Indices in the step.
    jacobians : tuple of (K, r, d) float64
        Whitened.
    """

    variables: tuple[Int64Array, ...]
    jacobians: tuple[Float64Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """K relative poses between two frames each.

    Attributes
    ----------
    a, b : (K,) int64
        Indices of the state's poses.
    a_from_b : (K, 3) float64
    whitening : (K, 3, 3) float64
        Turns a residual into one of unit covariance.
    """

    a: Int64Array
    b: Int64Array
    a_from_b: Float64Array
    whitening: Float64Array

    def __len__(self) -> int:
        return len(self.a)

    def errors(self, state: GraphState) -> Float64Array:
        """Return (K, 3) whitened residuals."""
        seen = relative_poses(state.poses[self.a], state.poses[self.b])
        raw = relative_poses(self.a_from_b, seen)
        errors: Float64Array = np.einsum("kij,kj->ki", self.whitening, raw)
        return errors

    def jacobians(self, state: GraphState) -> Jacobians:
        """Return the derivatives by either pose."""
        seen = relative_poses(state.poses[self.a], state.poses[self.b])
        back = _rotations(-self.a_from_b[:, 2])
        of_b = np.zeros((len(self), 3, 3))
        of_b[:, :2, :2] = _rotations(seen[:, 2] - self.a_from_b[:, 2])
        of_b[:, 2, 2] = 1.0
        of_a = np.zeros((len(self), 3, 3))
        of_a[:, :2, :2] = -back
        of_a[:, :2, 2] = np.einsum("kij,kj->ki", back, np.column_stack([seen[:, 1], -seen[:, 0]]))
        of_a[:, 2, 2] = -1.0
        return Jacobians(
            (_pose_indices(self.a), _pose_indices(self.b)),
            (self.whitening @ of_a, self.whitening @ of_b),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Headings:
    """K headings of the robot by a compass.

    Attributes
    ----------
    pose : (K,) int64
    turn : (K,) float64
        Of the robot from that pose to the moment of the reading, radians.
    heading, sigma : (K,) float64, radians
    """

    pose: Int64Array
    turn: Float64Array
    heading: Float64Array
    sigma: Float64Array

    def __len__(self) -> int:
        return len(self.pose)

    def errors(self, state: GraphState) -> Float64Array:
        """Return (K, 1) whitened residuals."""
        predicted = state.poses[self.pose, 2] + self.turn + state.compass_offset
        wrapped = (predicted - self.heading + np.pi) % (2.0 * np.pi) - np.pi
        errors: Float64Array = (wrapped / self.sigma)[:, None]
        return errors

    def jacobians(self, state: GraphState) -> Jacobians:
        """Return the derivatives by the pose's heading and by the compass offset."""
        inverse = (1.0 / self.sigma)[:, None, None]
        offset = np.full((len(self), 1), 3 * len(state.poses))
        return Jacobians((3 * self.pose[:, None] + 2, offset), (inverse, inverse))


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """K positions of the antenna, east and north of the datum, by GPS.

    Attributes
    ----------
    pose : (K,) int64
    motion : (K, 3) float64
        ``pose_from_robot`` at the moment of the reading.
    east_north : (K, 2) float64, metres
    sigma : (K,) float64, metres
    """

    pose: Int64Array
    motion: Float64Array
    east_north: Float64Array
    sigma: Float64Array

    def __len__(self) -> int:
        return len(self.pose)

    def errors(self, state: GraphState) -> Float64Array:
        """Return (K, 2) whitened residuals."""
        in_map = compose_poses(state.poses[self.pose], self._antenna(state))
        predicted = compose_poses(state.east_north_from_map, in_map)[:, :2]
        errors: Float64Array = (predicted - self.east_north) / self.sigma[:, None]
        return errors

    def jacobians(self, state: GraphState) -> Jacobians:
        """Return the derivatives by the pose, the datum and the lever arm."""
        antenna = self._antenna(state)
        antenna[:, 2] = 0.0
        in_map = compose_poses(state.poses[self.pose], antenna)
        turn = float(state.east_north_from_map[2])
        heading = state.poses[self.pose, 2]
        scale = (1.0 / self.sigma)[:, None, None]
        offsets = np.full((len(self), 1), 3 * len(state.poses))
        return Jacobians(
            (_pose_indices(self.pose), offsets + np.arange(1, 4), offsets + np.arange(4, 6)),
            (
                scale * _arm(_rotations(turn + heading), antenna[:, :2]),
                scale * _arm(_rotations(np.full(len(self), turn)), in_map[:, :2]),
                scale * _rotations(turn + heading + self.motion[:, 2]),
            ),
        )

    def _antenna(self, state: GraphState) -> Float64Array:
        """Return (K, 3) poses of the antenna in each pose's frame."""
        return compose_poses(self.motion, np.append(state.lever_arm, 0.0))


Factors = Motions | Headings | Positions
Kind = TypeVar("Kind", bound=Factors)


def some_of(factors: Kind, indices: Int64Array) -> Kind:
    """Return some of the factors."""
    return type(factors)(*(getattr(factors, field.name)[indices] for field in fields(factors)))


def _pose_indices(poses: Int64Array) -> Int64Array:
    return 3 * poses[:, None] + np.arange(3)


def _arm(rotations: Float64Array, points: Float64Array) -> Float64Array:
    """Return (K, 2, 3): derivatives of points by the frame that each is fixed to."""
    lever = np.stack([-points[:, 1], points[:, 0]], axis=1)
    return np.concatenate([rotations, rotations @ lever[:, :, None]], axis=2)


def _rotations(angles: Float64Array) -> Float64Array:
    """Return (K, 2, 2) rotation matrices of (K,) radians."""
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], axis=1)
