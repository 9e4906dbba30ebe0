"""The unknowns of a photometric refinement, and the residuals of one level at a state of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel
from slamcli.stages.dense import pyramid, rocking
from slamcli.stages.dense.covariance import FitState

MIN_TEMPLATE_PIXELS = 200


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """A motion that is known beforehand, with its covariance.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m), theta (rad) in b's own axes.
    """

    a_from_b: Pose2
    covariance: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class WarpModel:
    """The unknowns: rigid motion, gain, offset, and K deviations of each frame's mounting.

    Attributes
    ----------
    calibration : Calibration
    sigmas : (K,) float64
        Of the mounting's deviations: pitch, roll (rad) and height (m); (0,) for a steady camera.
    prior : MotionPrior or None
    """

    calibration: Calibration
    sigmas: Float64Array
    prior: MotionPrior | None

    def start(self, a_from_b: Pose2) -> FitState:
        """Return the state of a motion with the mounting as calibrated."""
        return FitState(a_from_b, np.zeros(len(self.sigmas)), np.zeros(len(self.sigmas)))

    def prior_information(self) -> Float64Array:
        """Return the (5 + 2 K, 5 + 2 K) information of the priors."""
        information = np.diag(np.concatenate([np.zeros(5), np.ones(2 * len(self.sigmas))]))
        if self.prior is not None:
            information[:3, :3] = invert(self.prior.covariance)
        return information

    def prior_deviation(self, state: FitState) -> Float64Array:
        """Return (5 + 2 K,): a state's deviation from the priors, the mounting's in sigmas."""
        deviation = np.zeros(5 + 2 * len(self.sigmas))
        if self.prior is not None:
            apart = self.prior.a_from_b.inverse() @ state.a_from_b
            deviation[:3] = apart.x, apart.y, apart.theta
        if len(self.sigmas):
            deviation[5:] = np.concatenate(
                [state.mounting_a / self.sigmas, state.mounting_b / self.sigmas]
            )
        return deviation

    def moved(self, state: FitState, step: Float64Array) -> FitState:
        """Return a state after a (5 + 2 K,) step."""
        count = len(self.sigmas)
        return FitState(
            state.a_from_b @ Pose2(float(step[0]), float(step[1]), float(step[2])),
            state.mounting_a + step[5 : 5 + count] * self.sigmas,
            state.mounting_b + step[5 + count :] * self.sigmas,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residuals of one level at a state, and their slopes.

    Attributes
    ----------
    jacobian : (N, 5 + 2 K) float64
    residual : (N,) float64
    pixels, points : (N, 2) float64
        In b's level and on its floor, metres.
    contrast : float
        Standard deviation of the template's values.
    """

    jacobian: Float64Array
    residual: Float64Array
    pixels: Float64Array
    points: Float64Array
    contrast: float


@dataclass(frozen=True, slots=True, eq=False)
class LevelResiduals:
    """The residuals of view a's points in view b, on one level.

    Attributes
    ----------
    a, b : PyramidLevel
    model : WarpModel
    shown_from_floor : (K, 3, 3) float64
        Metres to metres, with one sigma of each deviation of the mounting.
    shifts_a : (K, 2, N) float64, metres
        By which they shift view a's points.
    """

    a: PyramidLevel
    b: PyramidLevel
    model: WarpModel
    shown_from_floor: Float64Array
    shifts_a: Float64Array

    @classmethod
    def of(cls, a: PyramidLevel, b: PyramidLevel, model: WarpModel) -> LevelResiduals:
        """Return the residuals of two levels, with what is the same for every state."""
        shown_from_floor = rocking.shown_from_floor_by_each(model.calibration, model.sigmas)
        return cls(a, b, model, shown_from_floor, rocking.shifts(shown_from_floor, a.points))

    def linearise(self, state: FitState) -> Linearisation | None:
        """Return the residuals and their slopes at a state; None where b sees too few points."""
        floor_b, pixels_b = self._project(state)
        seen = np.flatnonzero(pyramid.sample(self.b.inside, pixels_b) > 254.5)
        if len(seen) < MIN_TEMPLATE_PIXELS:
            return None
        # Numpy takes this way, and from rows, several times as fast as it indexes.
        points = np.take(floor_b.T, seen, axis=1).T
        pixels = np.take(pixels_b.T, seen, axis=1).T
        gradients_a = np.take(self.a.gradients, seen, axis=0)
        values = self.a.values[seen]
        gradients = gradients_a @ state.a_from_b.matrix[:2, :2]
        slopes = np.empty((5 + 2 * len(self.model.sigmas), len(points)))
        slopes[:2] = -gradients.T
        slopes[2] = gradients[:, 0] * points[:, 1] - gradients[:, 1] * points[:, 0]
        slopes[3] = values
        slopes[4] = 1.0
        if len(self.model.sigmas):
            shifts_a = np.take(self.shifts_a, seen, axis=2)
            shifts_b = rocking.shifts(self.shown_from_floor, points)
            slopes[5:] = rocking.slopes(gradients_a, gradients, shifts_a, shifts_b)
        residual = pyramid.sample(self.b.detail, pixels) - values
        return Linearisation(slopes.T, residual, pixels, points, float(values.std()))

    def _project(self, state: FitState) -> tuple[Float64Array, Float64Array]:
        """Return (N, 2) points of view a on b's floor, metres, and in b's level, pixels."""
        calibration = self.model.calibration
        floor_from_shown_a = invert(rocking.shown_from_floor(calibration, state.mounting_a))
        floor_b = apply_homography(
            state.a_from_b.inverse().matrix @ floor_from_shown_a, self.a.points
        )
        pixel_from_floor_b = self.b.pixel_from_metres @ rocking.shown_from_floor(
            calibration, state.mounting_b
        )
        return floor_b, apply_homography(pixel_from_floor_b, floor_b)
