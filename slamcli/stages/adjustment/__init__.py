"""Bundle adjustment over a plane: camera, poses and each frame's rocking from tracked patches.

`patch_tracking` finds the same spots of the floor in two images, `solver` the camera and the poses
that explain them, `projection` transfers pixels from frame to frame for both.
"""

from slamcli.stages.adjustment.frame_poses import FramePose
from slamcli.stages.adjustment.observations import residual_lengths
from slamcli.stages.adjustment.patch_tracking import (
    Matches,
    choose_points,
    pixel_information,
    track,
)
from slamcli.stages.adjustment.projection import changed, transfer
from slamcli.stages.adjustment.pyramid import MAX_LEVEL, Pyramid, make_pyramid
from slamcli.stages.adjustment.solver import (
    INITIAL_ROCKING_SIGMAS,
    Adjustment,
    adjust,
)

__all__ = [
    "INITIAL_ROCKING_SIGMAS",
    "MAX_LEVEL",
    "Adjustment",
    "FramePose",
    "Matches",
    "Pyramid",
    "adjust",
    "changed",
    "choose_points",
    "make_pyramid",
    "pixel_information",
    "residual_lengths",
    "track",
    "transfer",
]
