"""The camera refines itself: what overlapping frames both see tells how it looks at the floor.

Frames are registered with the calibration as it is; from the spots that they share, camera, poses
and each frame's own tilt and height are estimated together (`stages.adjustment`), and the frames
are registered again with what came of it, until it stays the same. A camera is believed only when
the frames determine it, when it differs from the calibration by more than its own uncertainty, and
when it explains matches better that had no part in finding it.
"""

from slamcli.selfcal.bundle import RegisteredDrive
from slamcli.selfcal.rounds import SelfCalibration, refine

__all__ = ["RegisteredDrive", "SelfCalibration", "refine"]
