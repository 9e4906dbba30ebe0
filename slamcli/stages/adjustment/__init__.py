"""Camera, poses and each frame's rocking from what overlapping frames both see.

`patches` finds the same spots of the floor in two pictures, `solver` the camera and the poses that
explain them, `projection` carries pixels from frame to frame for both.
"""

from slamcli.stages.adjustment.patch_tracking import Matches, choose_points, track
from slamcli.stages.adjustment.projection import FramePose, changed, transfer
from slamcli.stages.adjustment.pyramid import MAX_LEVEL, Pyramid, make_pyramid
from slamcli.stages.adjustment.solver import (
    FIRST_ROCKING,
    Adjustment,
    adjust,
    residual_lengths,
)

__all__ = [
    "FIRST_ROCKING",
    "MAX_LEVEL",
    "Adjustment",
    "FramePose",
    "Matches",
    "Pyramid",
    "adjust",
    "changed",
    "choose_points",
    "make_pyramid",
    "residual_lengths",
    "track",
    "transfer",
]
