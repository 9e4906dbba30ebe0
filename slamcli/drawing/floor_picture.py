"""A picture of the floor so far, put together from keyframes as they come: for a screen."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.records import Keyframe

# The picture has at most this many pixels a side, and room for the floor to come.
_MAX_PIXELS, _ROOM = 1200, 0.3
# Of a keyframe's own pixels to one of the picture, at least.
_MIN_REDUCTION = 1.0
# Keyframes that moved by more than so many pixels of the picture are painted anew, with all others.
_MAX_MOVED_PIXELS = 1.0


class FloorPicture:
    """Gray views of keyframes, the newest on top, on a grid that grows.

    Parameters
    ----------
    view : Grid
        Of the frames' views that are compared, in the robot frame.

    Attributes
    ----------
    grid : Grid
        Of the picture, in the map's axes.
    image : (h, w, 2) uint8
        Gray, and alpha: 0 where no floor was seen.
    """

    def __init__(self, view: Grid) -> None:
        self._view = view
        self._painted: dict[int, Pose2] = {}
        self.grid = Grid(0.0, 0.0, view.metres_per_pixel, 1, 1)
        self.image: UInt8Array = np.zeros((1, 1, 2), np.uint8)

    def update(self, keyframes: Sequence[tuple[Keyframe, Pose2]]) -> bool:
        """Bring the picture up to date with keyframes and their poses; return whether it changed.

        Where all those painted before stay where they are, only the new ones are painted.
        """
        if not keyframes:
            return False
        corners = np.vstack([pose.apply(self._view.corners) for _, pose in keyframes])
        known = {keyframe.index: pose for keyframe, pose in keyframes}
        if not (self._covers(corners) and self._stays(known)):
            self._begin(corners)
        new = [(one, pose) for one, pose in keyframes if one.index not in self._painted]
        for keyframe, pose in new:
            self._paint(keyframe, pose)
            self._painted[keyframe.index] = pose
        return bool(new)

    def _covers(self, corners: Float64Array) -> bool:
        low, high = corners.min(axis=0), corners.max(axis=0)
        grid = self.grid
        return bool(
            grid.x_min <= low[0]
            and high[0] <= grid.x_max
            and grid.y_min <= low[1]
            and high[1] <= grid.y_max
        )

    def _stays(self, known: dict[int, Pose2]) -> bool:
        """Return whether all that is painted is still there, where it was painted."""
        limit = _MAX_MOVED_PIXELS * self.grid.metres_per_pixel
        reach = float(np.abs(self._view.corners).max())
        for index, before in self._painted.items():
            now = known.get(index)
            if now is None:
                return False
            moved = before.inverse() @ now
            if moved.translation_length + reach * abs(moved.theta) > limit:
                return False
        return True

    def _begin(self, corners: Float64Array) -> None:
        """Begin an empty picture that covers points, and room around them."""
        low, high = corners.min(axis=0), corners.max(axis=0)
        room = _ROOM * float((high - low).max())
        sides = high - low + 2.0 * room
        scale = max(_MIN_REDUCTION * self._view.metres_per_pixel, float(sides.max()) / _MAX_PIXELS)
        width, height = (int(np.ceil(side / scale)) for side in sides)
        self.grid = Grid(float(low[0]) - room, float(high[1]) + room, scale, width, height)
        self.image = np.zeros((height, width, 2), np.uint8)
        self._painted = {}

    def _paint(self, keyframe: Keyframe, pose: Pose2) -> None:
        """Paint one keyframe's view over what is there."""
        image, mask = (
            cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
            for data in (keyframe.image, keyframe.mask)
        )
        if image is None or mask is None:
            return
        # Where the picture is coarser than the view, this is reduced first, against aliasing.
        step = max(1, int(self.grid.metres_per_pixel / self._view.metres_per_pixel))
        height, width = (side // step for side in image.shape)
        image, mask = (
            cv2.resize(one[: height * step, : width * step], (width, height), interpolation=how)
            for one, how in ((image, cv2.INTER_AREA), (mask, cv2.INTER_NEAREST))
        )
        scale = step * self._view.metres_per_pixel
        view = Grid(self._view.x_min, self._view.y_max, scale, width, height)
        corners = apply_homography(self.grid.pixel_from_metres, pose.apply(self._view.corners))
        left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0).tolist()
        right, bottom = (np.ceil(corners.max(axis=0)).astype(int) + 1).tolist()
        part = self.image[top:bottom, left:right]
        size = (part.shape[1], part.shape[0])
        window = self.grid.window(left, top, *size)
        turned = (window.pixel_from_metres @ pose.matrix @ view.metres_from_pixel)[:2]
        warped = cv2.warpAffine(image, turned, size, flags=cv2.INTER_LINEAR)
        # All of a pixel must have been seen: outside its mask a view is black.
        seen = cv2.warpAffine(mask, turned, size, flags=cv2.INTER_LINEAR) == 255
        part[seen] = np.dstack([warped, np.full_like(warped, 255)])[seen]
