"""Pictures warped onto another view: what is not seen leaves no trace in what is."""

from __future__ import annotations

import numpy as np
from floor_pictures import SIDE, square_grid

from slamcli.core.geometry import Pose2
from slamcli.core.records import View
from slamcli.stages import dense
from slamcli.stages.dense.warping import warp_onto


def test_a_pixel_is_seen_whole_or_not_at_all() -> None:
    """Shares of a pixel that is not seen as small as a millionth would spoil it otherwise."""
    picture = np.full((SIDE, SIDE), 100, np.uint8)
    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[:, : SIDE // 2] = 0
    level = dense.make_levels(View(square_grid(SIDE), picture, mask))[0]
    for size in np.geomspace(1e-9, 1e-2, 60):
        motion = Pose2(float(size), -0.5 * float(size), float(size))
        moved, seen = warp_onto(level, level, motion.matrix, picture, mask)
        assert np.abs(moved[seen] - 100.0).max() < 1e-3
        assert not moved[~seen].any()
        assert 0.97 < np.count_nonzero(seen) / np.count_nonzero(mask) <= 1.0
