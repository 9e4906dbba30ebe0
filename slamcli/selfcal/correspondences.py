"""Correspondences: spots of the floor that two registered frames both show, by patch tracking."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, Link
from slamcli.stages import adjustment, view

FramePair = tuple[int, int]
Read = Callable[[int], Frame]

# [All thresholds here are guarded by benchmarks/self_calibration.py.]
# Frames that share less of their floor, and no link, are not compared.
_MIN_SHARED = 0.2
# With fewer matches a pair is represented by its link, at a few points of low weight.
_MIN_MATCHES = 12
_LOOSE_SIGMA_PIXELS = 3.0
_KEPT_PYRAMIDS = 10
_OVERLAP_STEP, _OVERLAP_STEPS = 8, 80


class Matcher:
    """Finder of correspondences between pairs of frames; may be shared by threads.

    Parameters
    ----------
    calibration : Calibration
    poses : mapping of frame index to FramePose
        The current estimates.
    links : sequence of Link
        They represent pairs with few matches.
    read : callable
        Returns a frame by its index.
    coarsest : int
        Pyramid level to start at.
    chosen_on : int
        Pyramid level that points are chosen on.
    """

    def __init__(
        self,
        calibration: Calibration,
        poses: Mapping[int, adjustment.FramePose],
        links: Sequence[Link],
        read: Read,
        coarsest: int,
        chosen_on: int = 0,
    ) -> None:
        self._calibration, self._poses, self._read = calibration, poses, read
        self._coarsest = coarsest
        self._links = {(min(link.a, link.b), max(link.a, link.b)): link for link in links}
        usable = resolution_image(calibration) > 0.0
        self._usable = np.where(usable, np.uint8(255), np.uint8(0))
        self._pyramid = lru_cache(maxsize=_KEPT_PYRAMIDS)(self._make_pyramid)
        self._information = lru_cache(maxsize=_KEPT_PYRAMIDS)(
            lambda index: adjustment.pixel_information(self._pyramid(index), chosen_on)
        )

    def match(self, pair: FramePair, count: int) -> adjustment.Matches | None:
        """Return up to about `count` matches of two frames; None when they share nothing."""
        a, b = pair
        poses = self._poses[a], self._poses[b]
        warp = partial(adjustment.transfer, self._calibration, *poses)
        seen = self._overlap(warp)
        share = np.count_nonzero(seen & self._usable) / np.count_nonzero(self._usable)
        if share < _MIN_SHARED and pair not in self._links:
            return None
        try:
            first, second = self._pyramid(a), self._pyramid(b)
        except FrameError:
            return None
        points = adjustment.choose_points(first, self._information(a), seen, count)
        kept, pixels, whitening = adjustment.track(first, second, points, warp, self._coarsest)
        if len(kept) >= _MIN_MATCHES:
            return adjustment.Matches(a, b, points[kept], pixels, whitening)
        return self._linked(pair, seen) if pair in self._links else None

    def _make_pyramid(self, index: int) -> adjustment.Pyramid:
        frame = self._read(index)
        mask = self._usable if frame.mask is None else np.minimum(self._usable, frame.mask)
        return adjustment.make_pyramid(view.to_gray(frame.image), mask)

    def _overlap(self, warp: Callable[[Float64Array], Float64Array]) -> UInt8Array:
        """Return (H, W) uint8: 255 at pixels of one frame whose floor the other sees."""
        height, width = self._usable.shape
        step = max(_OVERLAP_STEP, width // _OVERLAP_STEPS)
        columns, rows = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
        pixels = warp(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        column, row = np.where(np.isfinite(pixels), pixels, -1.0).T
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        inside[inside] = (
            self._usable[np.rint(row[inside]).astype(int), np.rint(column[inside]).astype(int)] > 0
        )
        coarse = np.where(inside.reshape(columns.shape), np.uint8(255), np.uint8(0))
        seen = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
        return np.asarray(seen, np.uint8)

    def _linked(self, pair: FramePair, seen: UInt8Array) -> adjustment.Matches | None:
        """Return a few spots of the floor as the pair's link maps them, at a low weight."""
        rows, columns = np.nonzero(seen & self._usable)
        if not len(rows):
            return None
        corners = [np.argmin(rows + columns), np.argmax(rows + columns)]
        corners += [np.argmin(rows - columns), np.argmax(rows - columns)]
        points = np.column_stack([columns[corners], rows[corners]]).astype(np.float64)
        link = self._links[pair]
        a_from_b = link.a_from_b if link.a == pair[0] else link.a_from_b.inverse()
        poses = adjustment.FramePose(Pose2(), Rocking()), adjustment.FramePose(a_from_b, Rocking())
        pixels = adjustment.transfer(self._calibration, *poses, points)
        known = np.isfinite(pixels).all(axis=1)
        loose = np.tile(np.eye(2) / _LOOSE_SIGMA_PIXELS, (int(known.sum()), 1, 1))
        return adjustment.Matches(*pair, points[known], pixels[known], loose)
