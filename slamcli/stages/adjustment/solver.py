"""Bundle adjustment over a plane: the camera and all poses that explain every match at once.

Levenberg-Marquardt on the reprojection error with analytic Jacobians and a redescending kernel
(Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000). The unknowns are the camera's, shared
by all frames, and each frame's pose with its rocking, by which its pitch, roll and height differ
from the camera's. The rocking has a zero-mean prior whose sigmas are estimated too (expectation
maximisation for variance components: Dempster, Laird and Rubin, 1977). The plane's scale is not
observable: it is fixed by the calibration's height.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import SuperLU, splu

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.geometry import Pose2
from slamcli.stages.adjustment.equations import (
    BundleState,
    Layout,
    Linearisation,
    estimate_unevenness,
    free_unknowns,
    linearise,
    normal_equations,
    prior_information,
    prior_residuals,
    residual_scale,
    total_cost,
)
from slamcli.stages.adjustment.frame_poses import FramePose
from slamcli.stages.adjustment.observations import Observations
from slamcli.stages.adjustment.patch_tracking import Matches
from slamcli.stages.adjustment.projection import CAMERA_PARAMETERS, changed
from slamcli.stages.adjustment.uncertainty import (
    camera_covariance,
    estimate_rocking,
    pose_covariances,
)

_MAX_ITERATIONS = 40
_MAX_RETRIES = 6
_CONVERGED = 1e-3
# While the sigmas of the rocking are still being estimated, full convergence would be wasted
# [guarded by benchmarks/self_calibration.py].
_LEARNING_ITERATIONS = 3
# Of pitch, roll (rad) and log height, to start from.
INITIAL_ROCKING_SIGMAS = np.array([0.004, 0.004, 0.01])


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """Result of a bundle adjustment.

    Attributes
    ----------
    calibration : Calibration
    poses : dict of int to FramePose
        By frame index.
    camera_change : (7,) float64
        Of log focal length, the first two radial coefficients, pitch, roll and principal point (in
        focal lengths), in all.
    camera_covariance : (7, 7) float64
        Zero where a parameter was fixed.
    pose_covariances : dict of int to (3, 3) float64
        Of x, y (m), theta (rad), in the robot's own axes; zero for a frame that defines its map.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and log height vary from frame to frame.
    scale : float
        How many times larger residuals are than the matches' sigmas predict.
    unevenness_metres : float
        Standard deviation of the floor's height.
    """

    calibration: Calibration
    poses: dict[int, FramePose]
    camera_change: Float64Array
    camera_covariance: Float64Array
    pose_covariances: dict[int, Float64Array]
    rocking_sigmas: Float64Array
    scale: float
    unevenness_metres: float


def adjust(
    calibration: Calibration,
    poses: Mapping[int, FramePose],
    matches: Sequence[Matches],
    anchors: Sequence[int],
    *,
    camera_free: BoolArray,
    rocking_sigmas: Float64Array,
    learning_rounds: int = 0,
) -> Adjustment:
    """Estimate camera, poses and rocking together.

    Parameters
    ----------
    calibration : Calibration
        The start; its height stays.
    poses : mapping of frame index to FramePose
        The start of every frame in `matches`.
    matches : sequence of Matches
    anchors : sequence of int
        Frames whose poses are fixed: one for each connected map.
    camera_free : (7,) bool
        Which of log focal length, two radial coefficients, pitch, roll and the principal point's
        column and row are estimated.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and log height vary from frame to frame; zeros: not at all.
    learning_rounds : int
        How many times those sigmas, and the floor's unevenness, are re-estimated; six suffice from
        any start.
    """
    frames = tuple(sorted({m.a for m in matches} | {m.b for m in matches}))
    layout = Layout(frames, free_unknowns(frames, anchors, camera_free, rocking_sigmas))
    state = BundleState(
        calibration, {index: poses[index] for index in frames}, np.zeros(CAMERA_PARAMETERS)
    )
    observations = Observations.of(matches, frames)
    rounds = 1 + (learning_rounds if np.any(rocking_sigmas) else 0)
    sigmas = rocking_sigmas
    for number in range(rounds):
        prior = prior_information(layout, sigmas)
        learning = 0 < number < rounds - 1
        iterations = _LEARNING_ITERATIONS if learning else _MAX_ITERATIONS
        state, scale, factor, found = _descend(state, observations, layout, prior, iterations)
        if number + 1 < rounds:
            sigmas = estimate_rocking(state, layout, factor)
            state = replace(state, unevenness_metres=estimate_unevenness(found, scale))
    return Adjustment(
        state.calibration,
        state.poses,
        state.change,
        camera_covariance(layout, state, factor, found, prior, scale),
        pose_covariances(layout, factor),
        sigmas,
        scale,
        state.unevenness_metres,
    )


def _descend(
    state: BundleState,
    observations: Observations,
    layout: Layout,
    prior: Float64Array,
    iterations: int,
) -> tuple[BundleState, float, SuperLU, Linearisation]:
    """Run Levenberg-Marquardt; return the state, the residuals' scale, and its last equations."""
    damping = 1e-4
    found = linearise(state, observations, layout)
    scale = residual_scale(found)
    for _ in range(iterations):
        cost = total_cost(found, scale, prior, prior_residuals(layout, state))
        normal, gradient = normal_equations(found, scale, prior, layout, state)
        diagonal = normal.diagonal()
        for _ in range(_MAX_RETRIES):
            damped = splu((normal + diags(damping * diagonal)).tocsc())
            step = np.where(layout.free, -damped.solve(gradient), 0.0)
            tried = _moved(state, layout, step)
            tried_found = linearise(tried, observations, layout)
            if total_cost(tried_found, scale, prior, prior_residuals(layout, tried)) <= cost:
                damping = max(damping / 10.0, 1e-9)
                break
            damping *= 10.0
        else:
            break
        expected = float(step @ (normal @ step))
        state, found = tried, tried_found
        before, scale = scale, residual_scale(found)
        if expected < _CONVERGED and abs(scale / before - 1.0) < 1e-3:
            break
    normal, _ = normal_equations(found, scale, prior, layout, state)
    return state, scale, splu(normal), found


def _moved(state: BundleState, layout: Layout, step: Float64Array) -> BundleState:
    """Return a state with a step (K,) added to its unknowns."""
    camera = step[:CAMERA_PARAMETERS]
    calibration = changed(state.calibration, camera)
    poses = {}
    for position, index in enumerate(layout.frames):
        own = step[layout.of_frame(position)]
        pose = state.poses[index]
        height = calibration.height_metres + pose.rocking.height_metres
        poses[index] = FramePose(
            pose.map_from_robot @ Pose2(float(own[0]), float(own[1]), float(own[2])),
            Rocking(
                pose.rocking.pitch_radians + float(own[3]),
                pose.rocking.roll_radians + float(own[4]),
                height * math.exp(float(own[5])) - calibration.height_metres,
            ),
        )
    return BundleState(calibration, poses, state.change + camera, state.unevenness_metres)
