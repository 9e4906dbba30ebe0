"""Obstacles are marked where they are, and the floor is not."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from command_line import slam

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions
from slamcli.stages import dense, view

CALIBRATION = photograph.make_camera(CameraOptions(size=(320, 240)))
MAPPER = slamcli.Mapper(CALIBRATION)
# Past the boxes, so that their sides are seen to swing.
START, MOTION = Pose2(-0.9, -0.3, 0.3), Pose2(0.08, 0.06, 0.06)
BOXES = (
    photograph.Box(START @ Pose2(0.42, 0.06, 0.3), (0.06, 0.05, 0.10), (40.0, 40.0, 190.0)),
    photograph.Box(START @ Pose2(0.40, -0.12, -0.2), (0.05, 0.05, 0.06), (200.0, 90.0, 60.0)),
)
ROCKING = DisturbanceOptions(rocking_degrees=0.1)


@dataclass(frozen=True)
class Pair:
    """Two frames of a floor, as images, prepared, and where boxes cover their views."""

    images: list
    prepared: list
    covered: list


@cache
def pair_of(kind, boxes, disturbances):
    floor = floors.make_floor(kind, FloorOptions(wear=0.5), 0.001, seed=1)
    photographers = [
        photograph.Photographer(photograph.World(floor, here), CALIBRATION) for here in (boxes, ())
    ]
    quiet = DisturbanceOptions(noise_gray=0.0)
    pair = Pair([], [], [])
    for index, pose in enumerate((START, START @ MOTION)):
        still = (pose, pose)
        generator = np.random.default_rng(index)
        image = photograph.take(photographers[0], still, 0.0, disturbances, generator)
        pair.images.append(image)
        pair.prepared.append(MAPPER.prepare(Frame(index, f"{index}", None, image)))
        with_boxes, without = (
            photograph.take(photographer, still, 0.0, quiet, np.random.default_rng(0)).astype(int)
            for photographer in photographers
        )
        differ = np.where(np.any(with_boxes != without, axis=2), np.uint8(255), np.uint8(0))
        whole = cv2.morphologyEx(differ, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        seen = view.make_view_resampler(CALIBRATION, MAPPER.metres_per_pixel)
        pair.covered.append(view.resample(np.asarray(whole), seen) > 127)
    return pair


def obstacles_of(pair, tilt_degrees=0.1):
    first, second = pair.prepared
    refined = dense.refine(
        first.levels, second.levels, MOTION, CALIBRATION, math.radians(tilt_degrees)
    )
    assert refined is not None
    warp = refined.view_a_from_view_b
    return dense.find_obstacles(first.levels, second.levels, warp, CALIBRATION), warp


def near_obstacles(pair, warp, marks):
    """Cells at most one away from where a box is shown, in the first view or in the second."""
    grid = pair.prepared[0].view.grid
    first_from_second = grid.pixel_from_metres @ warp @ grid.metres_from_pixel
    second = cv2.warpPerspective(
        pair.covered[1].astype(np.uint8), first_from_second, (grid.width, grid.height)
    )
    either = pair.covered[0] | (np.asarray(second) > 0)
    cells_from_pixel = marks.cells_from_metres @ grid.metres_from_pixel
    rows, columns = np.nonzero(either)
    cells = np.zeros(marks.unlike.shape, np.uint8)
    places = np.column_stack([columns, rows, np.ones(len(rows))]) @ cells_from_pixel.T
    column, row = np.rint(places[:, :2]).astype(int).T
    cells[np.clip(row, 0, len(cells) - 1), np.clip(column, 0, cells.shape[1] - 1)] = 1
    return cv2.dilate(cells, np.ones((3, 3), np.uint8)) > 0


def test_boxes_are_marked_and_the_floor_is_not():
    pair = pair_of("asphalt", BOXES, ROCKING)
    marks, warp = obstacles_of(pair)
    near = near_obstacles(pair, warp, marks)
    assert np.count_nonzero(marks.unlike) >= 10
    assert np.count_nonzero(marks.unlike & near) >= 0.9 * np.count_nonzero(marks.unlike)
    assert not np.any(marks.unlike & ~marks.judged)
    # Both boxes, which lie to the left and to the right of the path.
    half = len(near) // 2
    assert np.any(marks.unlike[:half])
    assert np.any(marks.unlike[half:])


@pytest.mark.parametrize("kind", ["asphalt", "course"])
def test_an_empty_floor_has_no_obstacles(kind):
    rough = DisturbanceOptions(flicker=0.4, vignetting=0.3, rocking_degrees=0.2, noise_gray=4.0)
    marks, _ = obstacles_of(pair_of(kind, (), rough), 0.2)
    assert np.count_nonzero(marks.judged) > 100
    assert np.count_nonzero(marks.unlike) <= 0.01 * np.count_nonzero(marks.judged)


def test_points_are_looked_up_in_their_own_cells():
    pair = pair_of("asphalt", BOXES, ROCKING)
    marks, _ = obstacles_of(pair)
    row, column = np.argwhere(marks.unlike)[0]
    centres = np.array([[column, row, 1.0], [column + 0.4, row - 0.4, 1.0]])
    points = (centres @ np.linalg.inv(marks.cells_from_metres).T)[:, :2]
    assert marks.marks(points).all()
    assert not marks.marks(np.array([[50.0, 50.0], [-50.0, 0.0]])).any()
    blank = replace(marks, unlike=np.zeros_like(marks.unlike))
    assert not blank.marks(points).any()


def test_match_draws_obstacles(tmp_path):
    pair = pair_of("asphalt", BOXES, ROCKING)
    for name, image in zip(("a.png", "b.png"), pair.images, strict=True):
        write_image(tmp_path / name, image)
    save_calibration(tmp_path / "calibration.yaml", CALIBRATION)
    drawing = tmp_path / "match.png"
    arguments = ["match", tmp_path / "a.png", tmp_path / "b.png", "-o", drawing]
    result = slam(*arguments, "--json")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert min(facts["obstacles"]["cells"]) >= 10
    assert facts["first_from_second"]["x"] == pytest.approx(MOTION.x, abs=0.004)
    said = slam(*arguments, "--overwrite")
    assert "seems to stand on the floor" in said.stdout
    shown = cv2.imread(str(drawing)).astype(int)
    # The matches' lines are red or green too; the tint alone is pale.
    tinted = (shown[..., 2] - shown[..., 1] > 60) & (shown[..., 1] - shown[..., 0] == 0)
    assert np.count_nonzero(tinted) > 10 * 16 * 16 / 4
