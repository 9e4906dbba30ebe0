"""trajectory.png: its axes lie where the map says, and it shows what the poses do not tell."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import PoseEstimate
from slamcli.drawing import trajectory
from slamcli.drawing.trajectory import draw_trajectory

GRID = Grid(-1.0, 2.0, 0.01, 400, 300)
RED = np.array([40, 40, 220])


def estimates(indices: list[int], *, sigmas: bool = True) -> list[PoseEstimate]:
    covariance = np.eye(3) * 1e-6
    return [
        PoseEstimate(
            index,
            f"{index}.jpg",
            None,
            Pose2(0.25 * index, 0.5),
            "tracked",
            covariance=covariance * (1 + index) if sigmas else None,
        )
        for index in indices
    ]


def drawn(found: list[PoseEstimate]) -> UInt8Array:
    image = np.full((300, 400, 3), 120, np.uint8)
    return draw_trajectory(image, np.full((300, 400), 255, np.uint8), GRID, found, "m")


def test_a_tick_of_the_axis_is_below_its_place_on_the_map() -> None:
    """The map's left edge lies at x = -1, where there is a tick, and its right one at 3."""
    picture = drawn(estimates([0, 1, 2]))
    bottom = picture.shape[0] - trajectory._AXIS - trajectory._LEGEND
    below = picture[bottom + 3].max(axis=1)
    ticks = np.flatnonzero(below < 60)
    middle = bottom - (bottom - trajectory._TOP) // 2
    inside = np.abs(picture[middle].astype(int).mean(axis=1) - 245) > 20
    inside[: trajectory._LEFT + 2] = inside[-trajectory._RIGHT - 2 :] = False
    left, right = np.flatnonzero(inside)[[0, -1]]
    assert np.abs(ticks - left).min() <= 1
    assert np.abs(ticks - right).min() <= 1
    # Half a metre from tick to tick.
    assert len(ticks) == 9
    np.testing.assert_allclose(np.diff(ticks), (right - left) / 8, atol=1.5)


def test_lost_frames_are_a_dashed_line_and_are_in_the_legend() -> None:
    def red(picture: UInt8Array) -> int:
        return int(np.count_nonzero(np.abs(picture.astype(int) - RED).max(axis=2) < 12))

    assert red(drawn(estimates([0, 1, 2, 3]))) == 0
    assert red(drawn(estimates([0, 1, 5, 6]))) > 100


def test_arrows_and_numbers_lie_on_top_of_a_dense_path() -> None:
    picture = drawn(
        [PoseEstimate(n, f"{n}.jpg", None, Pose2(0.01 * n, 0.5), "tracked") for n in range(240)]
    )
    path = np.abs(picture.astype(int) - trajectory._PATH_COLOUR).max(axis=2) < 12
    row = round(np.flatnonzero(path.sum(axis=1) > 500).mean())
    dark = picture[row, trajectory._LEFT + 2 : -trajectory._RIGHT - 2].max(axis=1) < 60
    assert np.count_nonzero(dark) > 8 * trajectory._MAX_LABELS


def test_the_colour_bar_is_there_where_sigmas_are_known() -> None:
    known, unknown = drawn(estimates([0, 1, 2])), drawn(estimates([0, 1, 2], sigmas=False))
    yellow = np.array([37, 231, 253])
    counts = [
        int(np.count_nonzero(np.abs(one[-trajectory._LEGEND :].astype(int) - yellow).max(2) < 12))
        for one in (known, unknown)
    ]
    assert counts[0] > 30
    assert counts[1] == 0
    np.testing.assert_array_equal(known, drawn(estimates([0, 1, 2])))
