"""Camera calibration from points of known position on the floor.

The camera is a pinhole with square pixels; without intrinsics its principal point is the picture's
middle, and its focal length (and lens, by a chessboard) are solved for. `closed_form` starts, `fit`
refines, `mounting` has the results, `board` finds chessboards and markers.
"""

from slamcli.stages.calibrate.closed_form import sort_corners, square_target, squareness
from slamcli.stages.calibrate.fit import (
    FocalPrior,
    solve_mounting,
    solve_mounting_with_intrinsics,
    usual_focal,
)
from slamcli.stages.calibrate.mounting import (
    MISFIT_SIGMAS,
    FloorPoints,
    Mounting,
    lens_sigma,
    make_calibration,
)

__all__ = [
    "MISFIT_SIGMAS",
    "FloorPoints",
    "FocalPrior",
    "Mounting",
    "lens_sigma",
    "make_calibration",
    "solve_mounting",
    "solve_mounting_with_intrinsics",
    "sort_corners",
    "square_target",
    "squareness",
    "usual_focal",
]
