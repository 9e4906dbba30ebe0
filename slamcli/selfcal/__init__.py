"""Self-calibration: camera, poses and rocking estimated from a drive's own overlapping frames.

Rounds of registration and bundle adjustment over the plane alternate until the camera has
converged: frames are registered with a calibration, camera, poses and each frame's own tilt and
height are adjusted together to the spots that frames share (`stages.adjustment`), and the frames
are registered again with the result. The new camera is accepted only when the frames determine it,
when it differs from the calibration by more than its own uncertainty, and when it explains held-out
matches better.
"""

from slamcli.selfcal.bundle import BRIEF, THOROUGH, Effort, RegisteredDrive
from slamcli.selfcal.contradiction import contradiction_pixels, contradicts
from slamcli.selfcal.rounds import SelfCalibration, refine_calibration

__all__ = [
    "BRIEF",
    "THOROUGH",
    "Effort",
    "RegisteredDrive",
    "SelfCalibration",
    "contradiction_pixels",
    "contradicts",
    "refine_calibration",
]
