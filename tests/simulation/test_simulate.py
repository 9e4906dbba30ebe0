"""The simulator: what it draws lies where its ground truth has it."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from trajectories import read_poses, read_rows

from slamcli.cli.main import main
from slamcli.core.camera.projection import project_floor
from slamcli.core.geometry import Grid, Pose2
from slamcli.io.calibrations import load_calibration
from slamcli.simulation import drive, floors, photograph
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    FloorOptions,
    SimulationOptions,
)

SMALL = ["--size", "160x120", "--frames", "3", "--length", "0.3", "--workers", "2"]


def simulate(folder: Path, *arguments: str) -> None:
    result = CliRunner().invoke(main, ["simulate", str(folder), *SMALL, *arguments])
    assert result.exit_code == 0, result.output


def still(world_from_robot: Pose2) -> photograph.Shutter:
    return photograph.Shutter(world_from_robot, world_from_robot)


@pytest.mark.slow
def test_a_floor_is_the_same_in_whatever_windows_it_is_read() -> None:
    for kind in floors.FLOORS:
        whole = floors.make_floor(kind, FloorOptions(wear=0.5), 0.001, 1).region(
            Grid(-0.6, 0.6, 0.001, 700, 650)
        )
        part = floors.make_floor(kind, FloorOptions(wear=0.5), 0.001, 1).region(
            Grid(-0.3, 0.2, 0.001, 90, 80)
        )
        np.testing.assert_array_equal(part, whole[400:480, 300:390])
        other = floors.make_floor(kind, FloorOptions(wear=0.5), 0.001, 2).region(
            Grid(-0.3, 0.2, 0.001, 90, 80)
        )
        if kind != "course":
            assert not np.array_equal(part, other)


def test_blocks_meet_without_a_seam() -> None:
    texture = floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, 5).region(
        Grid(0.0, 0.0, 0.001, 1024, 512)
    )
    gray = texture[..., 0].astype(float)
    steps = np.abs(np.diff(gray, axis=1)).mean(axis=0)
    assert steps[511] < steps.mean() + 6 * steps.std()


def test_the_course_has_its_squares_where_its_plan_says() -> None:
    bare = floors.make_floor("course", FloorOptions(wear=0.0), 0.001, 0).region(
        Grid(-1.3, 0.7, 0.001, 2600, 1400)
    )
    white = (bare[..., 1] > 128).astype(np.uint8)
    count, _, stats, _ = cv2.connectedComponentsWithStats(cv2.erode(white, np.ones((60, 60))))
    assert count - 1 == 5
    np.testing.assert_allclose(stats[1:, cv2.CC_STAT_WIDTH] + 59, 304.8, atol=2)


def test_a_camera_that_looks_straight_down_rocks_about_both_axes() -> None:
    level = photograph.make_camera(CameraOptions(pitch_degrees=90.0))
    below = [[0.0, 0.0]]
    middle, _ = project_floor(level, below)
    ahead, _ = project_floor(photograph.tilted(level, 0.05, 0.0, 0.0), below)
    aside, _ = project_floor(photograph.tilted(level, 0.0, 0.05, 0.0), below)
    focal = level.camera_matrix[0, 0]
    moved = focal * math.tan(0.05)
    np.testing.assert_allclose(np.abs(ahead - middle), [[0.0, moved]], atol=1e-6)
    np.testing.assert_allclose(np.abs(aside - middle), [[moved, 0.0]], atol=1e-6)


def test_a_photo_shows_a_decal_where_the_camera_model_says() -> None:
    options = CameraOptions(size=(320, 240), k1=-0.2, roll_degrees=4.0)
    calibration = photograph.make_camera(options)
    place = Pose2(1.0, 2.0, 0.7)
    corners = 0.07 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    centre = np.array([[0.45, 0.06]])
    decal = photograph.Decal(place.apply(centre + corners), 250.0)
    floor = floors.make_floor("course", FloorOptions(wear=0.0), 0.001, 0)
    world = photograph.World(floor, decals=(decal,))
    photographer = photograph.Photographer(world, calibration)
    quiet = DisturbanceOptions(noise_gray=0.0, vignetting=0.0)
    image = photograph.take(photographer, (place, place), 0.0, quiet, np.random.default_rng(0))
    gray = image[..., 0].astype(float)
    rim = [np.linspace(corners[i - 1], corners[i], 20, endpoint=False) for i in range(4)]
    outline, _ = project_floor(calibration, centre + np.concatenate(rim))
    moments = cv2.moments(np.clip(gray - gray.min() - 5, 0, None))
    seen = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    polygon = cv2.moments(outline.astype(np.float32))
    expected = np.array([polygon["m10"], polygon["m01"]]) / polygon["m00"]
    np.testing.assert_allclose(seen, expected, atol=0.05)


def test_a_box_is_drawn_at_its_pose_and_hides_the_floor_behind() -> None:
    calibration = photograph.make_camera(CameraOptions(size=(320, 240)))
    box = photograph.Box(Pose2(0.6, 0.0, 0.3), (0.08, 0.08, 0.1), (40.0, 40.0, 250.0))
    floor = floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, 0)
    photographer = photograph.Photographer(photograph.World(floor, (box,)), calibration)
    image = photographer.expose(still(Pose2()), calibration, 0.0)
    red = (image[..., 2] > 100) & (image[..., 0] < 60)
    base = project_floor(calibration, [[0.6, 0.0]])[0][0]
    rows, columns = np.nonzero(red)
    assert rows.max() > base[1]
    assert rows.min() < base[1] - 15
    assert abs(np.median(columns) - base[0]) < 8


def test_paths_have_their_length_and_sensors_their_errors() -> None:
    for path in drive.PATHS:
        poses = drive.make_path(SimulationOptions(path=path, length_metres=6.0, frames=300))
        steps = [(a.inverse() @ b) for a, b in itertools.pairwise(poses)]
        total = sum(step.translation_length for step in steps)
        assert total == pytest.approx(6.0, rel=0.01)
        # A robot drives ahead; it does not slide sideways, unless it drifts as a drone does.
        sideways = max(abs(step.y) for step in steps) > 0.1 * total / len(steps) + 1e-6
        assert sideways == (path == "drift")
    readings = drive.sense(poses, SimulationOptions().sensors, np.random.default_rng(0))
    last = readings.odometry[-1]
    drift = math.hypot(last.x - poses[-1].x, last.y - poses[-1].y)
    assert 0.001 < drift < 0.6


def test_local_metres_become_degrees_as_on_the_ellipsoid() -> None:
    # A degree of latitude at 45 degrees is 111 131.7 m, of longitude 78 846.8 m (WGS84).
    places = drive.geodetic_from_local(np.array([[78846.8, 0.0], [0.0, 111131.7]]), (45.0, 7.0))
    np.testing.assert_allclose(places, [[45.0, 8.0], [46.0, 7.0]], atol=2e-5)


@pytest.mark.slow
def test_a_simulation_is_the_same_twice_and_complete(tmp_path: Path) -> None:
    simulate(tmp_path / "a", "--boxes", "3", "--rocking", "0.2", "--motion-blur", "0.5")
    simulate(tmp_path / "b", "--boxes", "3", "--rocking", "0.2", "--motion-blur", "0.5")
    names = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert {"truth.csv", "odometry.csv", "compass.csv", "gps.csv", "camera.yaml"} < {
        str(name) for name in names
    }
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    truth = read_poses(tmp_path / "a" / "truth.csv")
    assert list(truth) == ["0000.jpg", "0001.jpg", "0002.jpg"]
    assert truth["0000.jpg"] == Pose2()
    calibration = load_calibration(tmp_path / "a" / "camera.yaml")
    assert calibration.height_metres == pytest.approx(0.3)
    assert len(read_rows(tmp_path / "a" / "gps.csv")) == 3


def test_its_boxes_are_polygons_in_the_map(tmp_path: Path) -> None:
    simulate(tmp_path / "a", "--boxes", "3", "--floor", "course")
    collection = json.loads((tmp_path / "a" / "obstacles.geojson").read_text())
    boxes = collection["features"]
    assert len(boxes) == 3
    for number, box in enumerate(boxes):
        ring = np.array(box["geometry"]["coordinates"][0])
        assert ring.shape == (5, 2)
        np.testing.assert_array_equal(ring[0], ring[-1])
        x, y = ring[:-1].T
        area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        assert 0.04**2 <= area <= 0.12**2
        # Boxes lie about 0.4 to 1.1 m from the three first frames, which are at the map's origin.
        assert 0.3 < np.hypot(x.mean(), y.mean()) < 1.6
        moves = any(v for k, v in box["properties"].items() if k.startswith("velocity"))
        assert moves == (number == 2)


def test_a_path_of_poses_and_a_floor_of_a_picture(tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text("x,y,heading\n1,1,0\n1.1,1,0.1\n,,\n1.2,1.02,0.2\n")
    cv2.imwrite(str(tmp_path / "floor.png"), np.full((100, 100, 3), 90, np.uint8))
    simulate(
        tmp_path / "out",
        *("--path", str(tmp_path / "way.csv"), "--floor", str(tmp_path / "floor.png")),
    )
    truth = read_poses(tmp_path / "out" / "truth.csv")
    assert len(truth) == 3
    assert truth["0001.jpg"].x == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--floor", "lava"], "neither asphalt"),
        (["--path", "absent.csv"], "neither line"),
        (["--square-side", "9"], "smaller --square-side"),
    ],
)
def test_an_impossible_option_is_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(main, ["simulate", str(tmp_path / "x"), *SMALL, *arguments])
    assert result.exit_code == 1
    assert words in result.output
    assert result.output.count("\n") == 1


def test_tiles_without_wear_are_all_alike() -> None:
    floor = floors.make_floor("tiles", FloorOptions(wear=0.0), 0.0005, 1)
    first = floor.region(Grid(0.0, 0.1, 0.0005, 200, 200))
    other = floor.region(Grid(0.7, 0.4, 0.0005, 200, 200))
    np.testing.assert_array_equal(first, other)
    worn = floors.make_floor("tiles", FloorOptions(wear=0.5), 0.0005, 1)
    assert not np.array_equal(worn.region(Grid(0.0, 0.1, 0.0005, 200, 200)), first)


def test_a_room_has_its_walls_where_its_size_says() -> None:
    calibration = photograph.make_camera(CameraOptions(size=(320, 240), pitch_degrees=10.0))
    room = photograph.Room((0.0, 0.0), 4.0, floors.make_wall(FloorOptions(wear=0.0), 0.002, 0))
    floor = floors.make_floor("course", FloorOptions(wear=0.0), 0.001, 0)
    photographer = photograph.Photographer(photograph.World(floor, room=room), calibration)
    image = photographer.expose(still(Pose2(0.5, 0.0, 0.0)), calibration, 0.0)[..., 1]
    # The wall ahead is 1.5 m away: below its foot the black floor, above it the gray skirting.
    foot = project_floor(calibration, [[1.5, 0.0]])[0][0]
    column, row = round(foot[0]), foot[1]
    assert image[math.floor(row) - 3, column] > 45
    assert image[math.ceil(row) + 3, column] < 30


def test_walkers_cross_the_view() -> None:
    poses = drive.make_path(SimulationOptions(path="line", length_metres=4.0, frames=40))
    legs = drive.send_walkers(poses, 5, 10.0, np.random.default_rng(0))
    assert len(legs) == 10
    for leg in legs[::2]:
        near = [
            (
                pose.inverse()
                @ Pose2(
                    leg.world_from_box.x + index / 10.0 * leg.velocity[0],
                    leg.world_from_box.y + index / 10.0 * leg.velocity[1],
                )
            )
            for index, pose in enumerate(poses)
        ]
        assert min(math.hypot(place.x - 0.6, place.y) for place in near) < 0.25
