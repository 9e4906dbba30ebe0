"""The unknowns of a photometric refinement, and the residuals of one level at a state of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel, SampledLevel
from slamcli.stages.dense import pyramid, rocking, sparse_view
from slamcli.stages.dense.covariance import FitState

MIN_TEMPLATE_PIXELS = 200
# Points of a level that represent all of them
# [guarded by benchmarks/accuracy.py and benchmarks/streaming.py].
_SAMPLE_POINTS = 4000


def sampled(level: PyramidLevel, count: int = _SAMPLE_POINTS) -> PyramidLevel:
    """Return a level with some of its points, evenly taken; itself where these are few."""
    step = -(-len(level.points) // count)
    return level.part(slice(None, None, step)) if step > 1 else level


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
    slopes : (5 + 2 K, N) float64
    residual : (N,) float64
    places : Places
        Of the residuals' points, in b's level.
    contrast : float
        Standard deviation of the template's values.
    """

    slopes: Float64Array
    residual: Float64Array
    places: pyramid.Places
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
    reach_metres : float
        Of view a's points from robot a, along either axis.
    """

    a: PyramidLevel
    b: PyramidLevel | SampledLevel
    model: WarpModel
    shown_from_floor: Float64Array
    shifts_a: Float64Array
    reach_metres: float

    @classmethod
    def of(
        cls, a: PyramidLevel, b: PyramidLevel | SampledLevel, model: WarpModel
    ) -> LevelResiduals:
        """Return the residuals of two levels, with what is the same for every state."""
        shown_from_floor = rocking.shown_from_floor_by_each(model.calibration, model.sigmas)
        shifts_a = rocking.shifts(shown_from_floor, a.points)
        return cls(a, b, model, shown_from_floor, shifts_a, float(np.abs(a.points).max()))

    def linearise(self, state: FitState) -> Linearisation | None:
        """Return the residuals and their slopes at a state; None where b sees too few points."""
        places = pyramid.Places.of(self._pixels(state)).among(self.b.inside)
        chosen = places.chosen
        if len(chosen) < MIN_TEMPLATE_PIXELS:
            return None
        # Numpy takes this way, and from rows, several times as fast as it indexes.
        of_template = np.take(self.a.template.value.slopes, chosen, axis=1)
        values = of_template[3]
        slopes = _by_motion(state.a_from_b) @ of_template
        if len(self.model.sigmas):
            shifts_a = np.take(self.shifts_a, chosen, axis=2)
            shifts_b = rocking.shifts(self.shown_from_floor, self.points(state, chosen))
            by_rocking = rocking.slopes(of_template[:2], -slopes[:2], shifts_a, shifts_b)
            slopes = np.concatenate([slopes, by_rocking])
        residual = sparse_view.detail_at(self.b, places) - values
        return Linearisation(slopes, residual, places, float(values.std()))

    def points(self, state: FitState, chosen: Int64Array) -> Float64Array:
        """Return (N, 2): where some points of view a lie on b's floor, metres."""
        points_a = np.take(self.a.points, chosen, axis=0)
        return apply_homography(self._floor_b_from_view_a(state), points_a)

    def _pixels(self, state: FitState) -> Float64Array:
        """Return (2, N): columns and rows of view a's points in b's level."""
        pixel_from_floor = self.b.pixel_from_metres
        if len(self.model.sigmas):
            pixel_from_floor = pixel_from_floor @ rocking.shown_from_floor(
                self.model.calibration, state.mounting_b
            )
        to_pixel = pixel_from_floor @ self._floor_b_from_view_a(state)
        rows = to_pixel[:, :2] @ self.a.points.T + to_pixel[:, 2:]
        return rows[:2] if not to_pixel[2, :2].any() else rows[:2] / rows[2]

    def _floor_b_from_view_a(self, state: FitState) -> Float64Array:
        """Return (3, 3), metres to metres."""
        b_from_a = state.a_from_b.inverse().matrix
        if not len(self.model.sigmas):
            return b_from_a
        shown_a = rocking.shown_from_floor(self.model.calibration, state.mounting_a)
        return b_from_a @ invert(shown_a)


def _by_motion(a_from_b: Pose2) -> Float64Array:
    """Return (5, 5): slopes by a motion in b's axes, gain and offset, from a template's own."""
    cosine, sine = math.cos(a_from_b.theta), math.sin(a_from_b.theta)
    by_motion = np.eye(5)
    by_motion[0, :2] = -cosine, -sine
    by_motion[1, :2] = sine, -cosine
    # The turn is about robot b, not about robot a.
    by_motion[2, :3] = -a_from_b.y, a_from_b.x, -1.0
    return by_motion
