"""A pose graph as arrays: what is sought, what was measured, and how the one misses the other.

A pose is perturbed on its right, ``pose @ (dx, dy, dtheta)``, in its own axes: GTSAM's tangent
space. Jacobians after Sola, Deray and Atchuthan, A micro Lie theory (2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import compose_poses, relative_poses

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The first frame defines the map, so it is held this firmly (m, m, rad).
ANCHOR_SIGMA = 1e-6
# What no reading tells of is held as loosely as this: it must not make the equations singular.
_LOOSE_SIGMA = 1e4
# A robot's antenna is on the robot (m).
_LEVER_SIGMA = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What is sought.

    Attributes
    ----------
    poses : (N, 3) float64
        ``map_from_robot``: x, y (m), theta (rad).
    senses : (6,) float64
        The compass's offset (rad): its heading less that in the map; ``east_north_from_map``; the
        GPS antenna in the robot's frame (m).
    """

    poses: NDArray[np.float64]
    senses: NDArray[np.float64]

    @property
    def compass_offset(self) -> float:
        """Radians, to be added to a heading in the map."""
        return float(self.senses[0])

    @property
    def east_north_from_map(self) -> NDArray[np.float64]:
        """(3,): x, y (m), theta (rad)."""
        return self.senses[1:4]

    @property
    def lever_arm(self) -> NDArray[np.float64]:
        """(2,) metres, ahead and to the left."""
        return self.senses[4:]

    def moved(self, step: NDArray[np.float64]) -> State:
        """Return the state after a step of the solver, (3 N + 6,)."""
        count = 3 * len(self.poses)
        poses = compose_poses(self.poses, step[:count].reshape(-1, 3))
        offset, turn, lever = np.split(step[count:], [1, 4])
        senses = np.concatenate(
            [
                self.senses[:1] + offset,
                compose_poses(self.east_north_from_map, turn),
                self.lever_arm + lever,
            ]
        )
        return State(poses, senses)


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Between two poses: M of them.

    Attributes
    ----------
    a, b : (M,) int64
        Places in the state's poses.
    a_from_b : (M, 3) float64
    whitening : (M, 3, 3) float64
        Turns a residual into one of unit covariance.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    a_from_b: NDArray[np.float64]
    whitening: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Headings:
    """Of the robot, by a compass: K of them.

    Attributes
    ----------
    pose : (K,) int64
    turn : (K,) float64
        Of the robot from that pose to the moment of the reading, radians.
    heading, sigma : (K,) float64, radians
    """

    pose: NDArray[np.int64]
    turn: NDArray[np.float64]
    heading: NDArray[np.float64]
    sigma: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Of the antenna, east and north of the datum, by GPS: G of them.

    Attributes
    ----------
    pose : (G,) int64
    motion : (G, 3) float64
        ``pose_from_robot`` at the moment of the reading.
    east_north : (G, 2) float64, metres
    sigma : (G,) float64, metres
    """

    pose: NDArray[np.int64]
    motion: NDArray[np.float64]
    east_north: NDArray[np.float64]
    sigma: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SensePrior:
    """What earlier readings told of the senses' offsets, and how surely.

    Attributes
    ----------
    senses : (6,) float64
        As in `State`.
    whitening : (6, 6) float64
        Turns what a state is off that, in its own axes, into one of unit covariance.
    """

    senses: NDArray[np.float64]
    whitening: NDArray[np.float64]

    def errors(self, state: State) -> NDArray[np.float64]:
        """Return (6,): by how much a state is off, whitened."""
        off = state.senses - self.senses
        off[1:4] = relative_poses(self.senses[1:4], state.east_north_from_map)
        return np.asarray(self.whitening @ off)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All factors, numbered on from motions over headings to places.

    Attributes
    ----------
    motions, headings, places
    shares : (F,) float64
        What each factor counts beside one that errs independently of all others.
    anchors : (A,) int64
        Places of the poses that are held: at least one for all that hangs together.
    lever_known : bool
    pose_count : int
    prior : SensePrior or None
    """

    motions: Motions
    headings: Headings
    places: Places
    shares: NDArray[np.float64]
    anchors: NDArray[np.int64]
    lever_known: bool
    pose_count: int
    prior: SensePrior | None = None

    def __len__(self) -> int:
        return len(self.motions.a) + len(self.headings.pose) + len(self.places.pose)

    def squared_errors(self, state: State) -> NDArray[np.float64]:
        """Return (F,): every factor's squared residual, in its own variances."""
        errors = (
            _motion_errors(self.motions, state),
            _heading_errors(self.headings, state),
            _place_errors(self.places, state),
        )
        return np.concatenate([np.sum(error**2, axis=1) for error in errors])

    def cost(self, state: State, weights: NDArray[np.float64]) -> float:
        """Return the weighted sum of squares that a solution makes least."""
        known = float(np.sum(self._sense_errors(state) ** 2))
        return float((weights * self.shares) @ self.squared_errors(state)) + known

    @property
    def _sense_whitening(self) -> NDArray[np.float64]:
        if self.prior is not None:
            return self.prior.whitening
        lever = ANCHOR_SIGMA if self.lever_known else _LEVER_SIGMA
        return np.diag(1.0 / np.array([_LOOSE_SIGMA] * 4 + [lever] * 2))

    def _sense_errors(self, state: State) -> NDArray[np.float64]:
        """Return (6,): by how much the senses' offsets are off what is known beforehand."""
        if self.prior is not None:
            return self.prior.errors(state)
        lever = np.zeros(2) if self.lever_known else state.lever_arm / _LEVER_SIGMA
        return np.concatenate([np.zeros(4), lever])

    def linearise(self, state: State, weights: NDArray[np.float64]) -> Equations:
        """Return the normal equations at a state, each factor weighted; those at 0 leave no trace.

        Parameters
        ----------
        state : State
        weights : (F,) float64
        """
        first, second = len(self.motions.a), len(self.motions.a) + len(self.headings.pose)
        count = len(state.poses)
        weights = weights * self.shares
        equations = Equations(3 * count + len(state.senses))
        used = np.flatnonzero(weights[:first])
        _add_motions(equations, self.motions, state, used, weights[used])
        used = np.flatnonzero(weights[first:second])
        _add_headings(equations, self.headings, state, used, weights[first + used])
        used = np.flatnonzero(weights[second:])
        _add_places(equations, self.places, state, used, weights[second + used])
        # What has lost all that tied it must not make the equations singular.
        anywhere = np.broadcast_to(np.eye(3) / _LOOSE_SIGMA, (count, 3, 3))
        equations.add([np.arange(3 * count).reshape(-1, 3)], [anywhere], np.zeros((count, 3)))
        held = len(self.anchors)
        firm = np.broadcast_to(np.eye(3) / ANCHOR_SIGMA, (held, 3, 3))
        fixed = 3 * self.anchors[:, None] + np.arange(3)
        equations.add([fixed], [np.asarray(firm)], np.zeros((held, 3)))
        # Else what is held between others would creep, a little each step, and none be the last.
        equations.gradient[fixed] = 0.0
        senses = (3 * count + np.arange(6))[None]
        slopes, residuals = self._sense_whitening, self._sense_errors(state)
        equations.add([senses], [slopes[None]], residuals[None])
        return equations


class Equations:
    """Normal equations ``H step = -gradient`` as they are added up."""

    def __init__(self, size: int) -> None:
        self.gradient = np.zeros(size)
        self._rows: list[NDArray[np.int64]] = []
        self._columns: list[NDArray[np.int64]] = []
        self._values: list[NDArray[np.float64]] = []

    @property
    def entries(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Rows, columns and values of H, (E,) each; those of one place add up."""
        return (
            np.concatenate(self._rows),
            np.concatenate(self._columns),
            np.concatenate(self._values),
        )

    def add(
        self,
        variables: list[NDArray[np.int64]],
        jacobians: list[NDArray[np.float64]],
        residuals: NDArray[np.float64],
    ) -> None:
        """Add K factors over the same kinds of variables.

        Parameters
        ----------
        variables : list of (K, d) int64
            Places in the step.
        jacobians : list of (K, r, d) float64
            Whitened.
        residuals : (K, r) float64
            Whitened.
        """
        for one, jacobian in zip(variables, jacobians, strict=True):
            np.add.at(self.gradient, one, np.einsum("krd,kr->kd", jacobian, residuals))
            for other, second in zip(variables, jacobians, strict=True):
                block = np.swapaxes(jacobian, 1, 2) @ second
                shape = block.shape
                self._rows.append(np.broadcast_to(one[:, :, None], shape).ravel())
                self._columns.append(np.broadcast_to(other[:, None, :], shape).ravel())
                self._values.append(block.ravel())


def _motion_errors(motions: Motions, state: State) -> NDArray[np.float64]:
    seen = relative_poses(state.poses[motions.a], state.poses[motions.b])
    raw = relative_poses(motions.a_from_b, seen)
    errors: NDArray[np.float64] = np.einsum("kij,kj->ki", motions.whitening, raw)
    return errors


def _add_motions(
    equations: Equations,
    motions: Motions,
    state: State,
    used: NDArray[np.int64],
    weights: NDArray[np.float64],
) -> None:
    some = Motions(
        motions.a[used], motions.b[used], motions.a_from_b[used], motions.whitening[used]
    )
    seen = relative_poses(state.poses[some.a], state.poses[some.b])
    back = _rotations(-some.a_from_b[:, 2])
    of_b = np.zeros((len(used), 3, 3))
    of_b[:, :2, :2] = _rotations(seen[:, 2] - some.a_from_b[:, 2])
    of_b[:, 2, 2] = 1.0
    of_a = np.zeros((len(used), 3, 3))
    of_a[:, :2, :2] = -back
    of_a[:, :2, 2] = np.einsum("kij,kj->ki", back, np.column_stack([seen[:, 1], -seen[:, 0]]))
    of_a[:, 2, 2] = -1.0
    root = np.sqrt(weights)
    whitening = root[:, None, None] * some.whitening
    residuals = root[:, None] * _motion_errors(some, state)
    variables = [3 * some.a[:, None] + np.arange(3), 3 * some.b[:, None] + np.arange(3)]
    equations.add(variables, [whitening @ of_a, whitening @ of_b], residuals)


def _heading_errors(headings: Headings, state: State) -> NDArray[np.float64]:
    told = state.poses[headings.pose, 2] + headings.turn + state.compass_offset
    wrapped = (told - headings.heading + np.pi) % (2.0 * np.pi) - np.pi
    errors: NDArray[np.float64] = (wrapped / headings.sigma)[:, None]
    return errors


def _add_headings(
    equations: Equations,
    headings: Headings,
    state: State,
    used: NDArray[np.int64],
    weights: NDArray[np.float64],
) -> None:
    root = np.sqrt(weights)
    slope = (root / headings.sigma[used])[:, None, None]
    residuals = root[:, None] * _heading_errors(headings, state)[used]
    offset = np.full((len(used), 1), 3 * len(state.poses))
    equations.add([3 * headings.pose[used][:, None] + 2, offset], [slope, slope], residuals)


def _place_errors(places: Places, state: State) -> NDArray[np.float64]:
    told = _told_places(places, state)[1]
    errors: NDArray[np.float64] = (told - places.east_north) / places.sigma[:, None]
    return errors


def _told_places(places: Places, state: State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (G, 2) places of the antenna in each pose's frame, and east and north of the datum."""
    lever = np.append(state.lever_arm, 0.0)
    antenna = compose_poses(places.motion, lever)
    in_map = compose_poses(state.poses[places.pose], antenna)
    return antenna[:, :2], compose_poses(state.east_north_from_map, in_map)[:, :2]


def _add_places(
    equations: Equations,
    places: Places,
    state: State,
    used: NDArray[np.int64],
    weights: NDArray[np.float64],
) -> None:
    some = Places(
        places.pose[used], places.motion[used], places.east_north[used], places.sigma[used]
    )
    antenna = _told_places(some, state)[0]
    in_map = compose_poses(state.poses[some.pose], np.pad(antenna, ((0, 0), (0, 1))))
    turn = float(state.east_north_from_map[2])
    heading = state.poses[some.pose, 2]
    root = np.sqrt(weights)
    scale = (root / some.sigma)[:, None, None]
    of_pose = scale * _arm(_rotations(turn + heading), antenna)
    of_datum = scale * _arm(_rotations(np.full(len(used), turn)), in_map[:, :2])
    of_lever = scale * _rotations(turn + heading + some.motion[:, 2])
    senses = np.full((len(used), 1), 3 * len(state.poses))
    variables = [
        3 * some.pose[:, None] + np.arange(3),
        senses + np.arange(1, 4),
        senses + np.arange(4, 6),
    ]
    residuals = root[:, None] * _place_errors(some, state)
    equations.add(variables, [of_pose, of_datum, of_lever], residuals)


def _arm(rotations: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (K, 2, 3): how a point moves with the frame that it is fixed to."""
    lever = np.stack([-points[:, 1], points[:, 0]], axis=1)
    return np.concatenate([rotations, rotations @ lever[:, :, None]], axis=2)


def _rotations(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (K, 2, 2) rotation matrices of (K,) radians."""
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], axis=1)
