"""The variables of a pose graph: poses, and the offsets of compass, GPS frame and antenna.

A pose is perturbed on its right, ``pose @ (dx, dy, dtheta)``, in its own axes: GTSAM's tangent
space. Jacobians after Sola, Deray and Atchuthan, A micro Lie theory (2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import compose_poses, relative_poses

# Sigma of what is fixed (m, rad): far below any measurement's, far above rounding errors.
ANCHOR_SIGMA = 1e-6
# Sigma of what no factor determines (m, rad): it must not make the equations singular.
LOOSE_SIGMA = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """The variables: poses, and the offsets of compass, GPS frame and antenna.

    Attributes
    ----------
    poses : (N, 3) float64
        ``map_from_robot``: x, y (m), theta (rad).
    offsets : (6,) float64
        The compass offset (rad): its heading minus that in the map; ``east_north_from_map``: x, y
        (m), theta (rad); the GPS antenna in the robot's frame (m).
    """

    poses: Float64Array
    offsets: Float64Array

    @property
    def compass_offset(self) -> float:
        """Radians, to be added to a heading in the map."""
        return float(self.offsets[0])

    @property
    def east_north_from_map(self) -> Float64Array:
        """(3,): x, y (m), theta (rad)."""
        return self.offsets[1:4]

    @property
    def lever_arm(self) -> Float64Array:
        """(2,) metres, ahead and to the left."""
        return self.offsets[4:]

    def plus(self, step: Float64Array) -> GraphState:
        """Return the state after a step of the solver, (3 N + 6,)."""
        count = 3 * len(self.poses)
        poses = compose_poses(self.poses, step[:count].reshape(-1, 3))
        compass, datum, lever = np.split(step[count:], [1, 4])
        offsets = np.concatenate(
            [
                self.offsets[:1] + compass,
                compose_poses(self.east_north_from_map, datum),
                self.lever_arm + lever,
            ]
        )
        return GraphState(poses, offsets)


@dataclass(frozen=True, slots=True, eq=False)
class SensorPrior:
    """Gaussian prior of the sensor offsets, before any reading of this graph.

    Attributes
    ----------
    offsets : (6,) float64
        As in `GraphState`.
    whitening : (6, 6) float64
        Turns a state's difference from these, in its own axes, into one of unit covariance.
    is_measured : bool
        Whether earlier readings determined compass and datum; if not, a first guess is made.
    """

    offsets: Float64Array
    whitening: Float64Array
    is_measured: bool

    def errors(self, state: GraphState) -> Float64Array:
        """Return (6,): the whitened difference of a state."""
        difference = state.offsets - self.offsets
        difference[1:4] = relative_poses(self.offsets[1:4], state.east_north_from_map)
        return np.asarray(self.whitening @ difference)
