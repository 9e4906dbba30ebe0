"""What a pose graph seeks, and what is known beforehand of the senses' part of it.

A pose is perturbed on its right, ``pose @ (dx, dy, dtheta)``, in its own axes: GTSAM's tangent
space. Jacobians after Sola, Deray and Atchuthan, A micro Lie theory (2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import compose_poses, relative_poses

# What is taken for certain is held this firmly (m, rad).
ANCHOR_SIGMA = 1e-6
# What no reading tells of is held as loosely as this: it must not make the equations singular.
LOOSE_SIGMA = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """What is sought.

    Attributes
    ----------
    poses : (N, 3) float64
        ``map_from_robot``: x, y (m), theta (rad).
    senses : (6,) float64
        The compass's offset (rad): its heading less that in the map; ``east_north_from_map``; the
        GPS antenna in the robot's frame (m).
    """

    poses: Float64Array
    senses: Float64Array

    @property
    def compass_offset(self) -> float:
        """Radians, to be added to a heading in the map."""
        return float(self.senses[0])

    @property
    def east_north_from_map(self) -> Float64Array:
        """(3,): x, y (m), theta (rad)."""
        return self.senses[1:4]

    @property
    def lever_arm(self) -> Float64Array:
        """(2,) metres, ahead and to the left."""
        return self.senses[4:]

    def moved(self, step: Float64Array) -> GraphState:
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
        return GraphState(poses, senses)


@dataclass(frozen=True, slots=True, eq=False)
class SensorPrior:
    """What is known of the senses' offsets before any reading of this graph, and how surely.

    Attributes
    ----------
    senses : (6,) float64
        As in `GraphState`.
    whitening : (6, 6) float64
        Turns what a state is off that, in its own axes, into one of unit covariance.
    told : bool
        Whether earlier readings told of compass and datum; if not, these are found anew.
    """

    senses: Float64Array
    whitening: Float64Array
    told: bool

    def errors(self, state: GraphState) -> Float64Array:
        """Return (6,): by how much a state is off, whitened."""
        off = state.senses - self.senses
        off[1:4] = relative_poses(self.senses[1:4], state.east_north_from_map)
        return np.asarray(self.whitening @ off)
