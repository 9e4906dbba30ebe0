"""Frames painted a second time, from their final poses, into the canvas of their map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import Grid
from slamcli.core.mounting import rocked
from slamcli.core.records import Tile
from slamcli.stages import camera, mosaic, view

if TYPE_CHECKING:
    from collections.abc import Sequence

    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Calibration, Frame, Rocking


class Painter:
    """Turns frames with poses into patches of the map; may be shared by threads.

    Parameters
    ----------
    calibration : Calibration
    metres_per_pixel : float
        Of the map.
    """

    def __init__(self, calibration: Calibration, metres_per_pixel: float) -> None:
        self.calibration = calibration
        self.metres_per_pixel = metres_per_pixel
        self._hull = camera.footprint_hull(calibration)
        self._weight = mosaic.picture_weight(camera.sharpness_image(calibration))

    def extent(self, poses: Sequence[Pose2]) -> Grid:
        """Return the grid in the map that covers all that could be seen from (N >= 1) poses."""
        points = np.vstack([pose.apply(self._hull) for pose in poses])
        return Grid.covering(points, self.metres_per_pixel)

    def patch(self, frame: Frame, map_from_robot: Pose2, rocking: Rocking | None = None) -> Tile:
        """Return what a frame saw, in the map, one resample away from the camera's picture."""
        grid = self.extent([map_from_robot])
        calibration = rocked(self.calibration, rocking) if rocking else self.calibration
        resampler = view.make_resampler(calibration, self._weight, grid, map_from_robot.inverse())
        seen = view.make_view(frame, resampler, gray=False)
        weight = np.where(seen.mask > 0, resampler.sharpness, np.float32(0.0))
        return Tile(grid, view.to_colour(seen.image), weight)
