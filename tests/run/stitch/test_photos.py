"""A drone's photos: a map in metres, on Earth, by what its camera noted."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.windows
from command_line import slam
from flights import FOCAL, SIZE, floor_picture, nadir_states, photographs
from photo_files import exif_of, write_photo
from trajectories import read_rows

from slamcli.core.camera.calibration import Rocking
from slamcli.core.geometry import Pose2
from slamcli.io.frames import list_frames
from slamcli.run.stitch import on_earth
from slamcli.stages.geodesy import LocalPlane
from slamcli.survey.ground import below_camera, fit_ground

METRES, HEADING, DATUM = 0.05, 0.7, (47.3, 8.5)
EARTH_FROM_MAP = Pose2(12.0, -7.0, HEADING)
# Focal length of a film camera with the field of view of the simulated one.
FOCAL_35MM = FOCAL * math.hypot(36.0, 24.0) / math.hypot(*SIZE)
GPS_METRES = 0.1


def earth(points: np.ndarray) -> np.ndarray:
    """Return metres east and north of points of the simulated floor."""
    return EARTH_FROM_MAP.apply(METRES * np.asarray(points))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Photos of a flight, one of them with a place far off, and the states of the camera."""
    folder = tmp_path_factory.mktemp("flight") / "photos"
    folder.mkdir()
    generator = np.random.default_rng(1)
    states = nadir_states(2, 3, generator)
    plane = LocalPlane(DATUM)
    for number, picture in enumerate(photographs(floor_picture(), states)):
        x, y, heading, log_scale, pitch, roll = states[number]
        height = FOCAL * (math.exp(log_scale) - 1.0)
        below = below_camera(Pose2(x, y, heading), Rocking(pitch, roll, height), FOCAL)
        place = earth([below])[0] + generator.normal(0.0, GPS_METRES, 2)
        place += (60.0, 0.0) if number == 5 else (0.0, 0.0)
        latitude, longitude = plane.geodetic([place])[0]
        exif = exif_of(
            time=f"2024:05:06 12:00:{number:02}",
            place=(latitude, longitude, 400.0),
            focal_35mm=round(FOCAL_35MM),
        )
        dji = {
            "RelativeAltitude": f"{METRES * FOCAL * math.exp(log_scale):+.2f}",
            "GimbalPitchDegree": "-90.0" if number else "-55.0",
            "GimbalYawDegree": f"{3.0 - math.degrees(heading + HEADING):+.1f}",
            "RtkStdLat": f"{GPS_METRES}",
            "RtkStdLon": f"{GPS_METRES}",
        }
        write_photo(folder / f"DJI_{number:04}.jpg", np.dstack([picture] * 3), exif, dji)
    return folder, states


def test_a_folder_of_a_drones_photos_is_a_map_on_earth(
    flight: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    folder, states = flight
    result = slam("stitch", folder, "-o", tmp_path / "map", "--crs", "auto")
    assert result.exit_code == 0, result.output
    assert "by the GPS of 5 of 6 photos" in result.output
    run = tomllib.loads((tmp_path / "map" / "run.toml").read_text())
    assert run["survey"]["metres_per_unit_by_height"] == pytest.approx(METRES, rel=0.03)
    # The simulated gimbal's compass is 3 degrees off.
    assert run["survey"]["gimbal_yaw_off_degrees"] == pytest.approx(3.0, abs=1.5)
    assert "1 of 6 photos look more than 20° off straight down" in result.output
    reference = run["georeference"]
    assert reference["gps_outliers"] == 1
    rows = read_rows(tmp_path / "map" / "poses.csv")
    ours = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    heading = math.radians(reference["x_axis_degrees_from_east"])
    datum = reference["datum_latitude_degrees"], reference["datum_longitude_degrees"]
    place = Pose2(reference["origin_east_metres"], reference["origin_north_metres"], heading)
    found = LocalPlane(DATUM).east_north
    theirs = [found(*one) for one in LocalPlane(datum).geodetic(place.apply(ours))]
    errors = np.linalg.norm(np.array(theirs) - earth(states[:, :2]), axis=1)
    # The sigma of the GPS is 0.1 m, and five places give four numbers.
    assert errors.max() < 0.3
    # Of the map; the meridians of the grid converge there by a third of a degree.
    assert reference["x_axis_degrees_from_east"] == pytest.approx(0.0, abs=1e-9)
    assert reference["crs_x_axis_degrees_from_east"] == pytest.approx(-0.37, abs=0.05)
    with rasterio.open(tmp_path / "map" / "mosaic.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert (raster.transform.b, raster.transform.d) == (0.0, 0.0)
        assert raster.overviews(1)
        utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
        turn = math.radians(reference["crs_x_axis_degrees_from_east"])
        origin = reference["crs_origin_east_metres"], reference["crs_origin_north_metres"]
        ours_in_grid = Pose2(*origin, turn).apply(ours)
        for number, state in enumerate(states):
            latitude, longitude = LocalPlane(DATUM).geodetic([earth(state[:2])])[0]
            true = utm.transform(longitude, latitude)
            assert math.dist(true, ours_in_grid[number]) < 0.3
            # What is shown there is the middle of that photo.
            row, column = raster.index(*ours_in_grid[number])
            window = rasterio.windows.Window(column - 8, row - 8, 17, 17)
            shown = raster.read(1, window=window).astype(float)
            assert raster.read(4, window=window).min() == 255
            x, y = ours[number]
            world = [float(v) for v in (tmp_path / "map" / "mosaic.pgw").read_text().split()]
            step, skew = world[0], world[1]
            turned = ((x - world[4]) - 1j * (y - world[5])) / (step - 1j * skew)
            mosaic = cv2.imread(str(tmp_path / "map" / "mosaic.png"))[..., 2].astype(float)
            top, left = round(turned.imag) - 8, round(turned.real) - 8
            assert np.abs(mosaic[top : top + 17, left : left + 17] - shown).mean() < 20.0
    again = slam("render", tmp_path / "map", "-o", tmp_path / "again", "--crs", "auto")
    assert again.exit_code == 0, again.output
    pictures = [(tmp_path / name / "mosaic.png").read_bytes() for name in ("map", "again")]
    assert pictures[0] == pictures[1]


def test_photos_of_which_a_few_have_no_place_are_a_survey(
    flight: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    folder, _ = flight
    photos = sorted(folder.iterdir())
    cv2.imwrite(str(tmp_path / "first.jpg"), cv2.imread(str(photos[0])))
    cv2.imwrite(str(tmp_path / "last.jpg"), cv2.imread(str(photos[-1])))
    assert on_earth.geotagged(list_frames([tmp_path / "first.jpg", *photos[1:4]]))
    assert on_earth.geotagged(list_frames([*photos[:4], tmp_path / "last.jpg"]))
    bare = [tmp_path / "first.jpg", tmp_path / "last.jpg"]
    assert not on_earth.geotagged(list_frames([*bare, photos[1]]))


def test_heights_alone_give_the_scale(flight: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, states = flight
    (tmp_path / "photos").mkdir()
    for number in range(4):
        picture = cv2.imread(str(folder / f"DJI_{number:04}.jpg"))
        height = METRES * FOCAL * math.exp(states[number, 3])
        write_photo(
            tmp_path / "photos" / f"{number}.jpg",
            picture,
            exif_of(focal_35mm=round(FOCAL_35MM)),
            {"RelativeAltitude": f"{height:+.2f}"},
        )
    result = slam("stitch", tmp_path / "photos", "-o", tmp_path / "map", "--mount", "hand")
    assert result.exit_code == 0, result.output
    assert "m a pixel by the heights of the photos" in result.output
    rows = read_rows(tmp_path / "map" / "poses.csv")
    ours = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    length = np.linalg.norm(np.diff(ours, axis=0), axis=1).sum()
    truth = METRES * np.linalg.norm(np.diff(states[:4, :2], axis=0), axis=1).sum()
    assert length == pytest.approx(truth, rel=0.03)


def test_places_too_close_for_their_sigma_give_no_scale() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform(0.0, 200.0, (9, 2))
    metres = 0.01 * points + generator.normal(0.0, 3.0, (9, 2))
    assert fit_ground(points, metres, np.full(9, 3.0)) is None


def test_the_sigmas_of_the_ground_are_those_of_its_errors() -> None:
    """Of scale, heading and the place of the origin, over many draws of the places' errors."""
    generator = np.random.default_rng(0)
    ratios = []
    for _ in range(200):
        points = generator.uniform(100.0, 700.0, (20, 2))
        metres = earth(points) + generator.normal(0.0, 1.0, (20, 2))
        found = fit_ground(points, metres, np.full(20, 1.0))
        assert found is not None
        pose = found.east_north_from_map
        error = np.array(
            [pose.x - EARTH_FROM_MAP.x, pose.y - EARTH_FROM_MAP.y, pose.theta - HEADING]
        )
        scale = math.log(found.metres_per_unit / METRES) / found.scale_sigma_share
        ratios.append([*(error / np.sqrt(np.diag(found.covariance))), scale])
    assert np.sqrt(np.mean(np.square(ratios), axis=0)) == pytest.approx(np.ones(4), abs=0.2)
