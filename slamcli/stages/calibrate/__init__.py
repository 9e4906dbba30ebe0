"""Camera calibration from points of known position on the floor.

The camera is a pinhole with square pixels; without intrinsics its principal point is the picture's
middle and its focal length is solved for. `closed_form` starts, `mounting` refines, `board` finds
chessboards and markers.
"""

from slamcli.stages.calibrate.closed_form import sort_corners, square_target, squareness
from slamcli.stages.calibrate.mounting import (
    MISFIT_SIGMAS,
    FloorPoints,
    Mounting,
    make_calibration,
    solve_mounting,
    solve_mounting_with_intrinsics,
)

__all__ = [
    "MISFIT_SIGMAS",
    "FloorPoints",
    "Mounting",
    "make_calibration",
    "solve_mounting",
    "solve_mounting_with_intrinsics",
    "sort_corners",
    "square_target",
    "squareness",
]
