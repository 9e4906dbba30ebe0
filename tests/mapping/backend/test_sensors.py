"""Odometry, compass and GPS in the pose graph, in worlds whose truth is known."""

from __future__ import annotations

import json
import math
import re
import shutil
import sys
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import slamcli
from slamcli.cli.main import main
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link, PreparedFrame
from slamcli.core.telemetry import (
    CompassReading,
    GpsReading,
    OdometryReading,
    TelemetryOptions,
)
from slamcli.io.telemetry import write_gps
from slamcli.io.trajectories import read_trajectory
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.backend.sensors import Sensors
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    FloorOptions,
    ImagingOptions,
    SimulationOptions,
)
from slamcli.simulation.drive import geodetic_from_local
from slamcli.stages import posegraph
from slamcli.stages.geodesy import LocalPlane

DATUM = (29.6436, -82.3549)
EARTH_FROM_MAP = Pose2(12.0, -7.0, 0.7)
RATE_HERTZ = 5.0


def winding(count: int, step: float) -> list[Pose2]:
    poses = [Pose2()]
    for index in range(count - 1):
        poses.append(poses[-1] @ Pose2(step, 0.0, 0.35 * step * math.sin(step * index / 3.0)))
    return poses


def drive(
    truth: list[Pose2],
    sensors: Sensors,
    seed: int,
    sigma: float,
    breaks: tuple[int, ...] = (),
    lost: tuple[int, ...] = (),
) -> Backend:
    """Steps with that noise (m, rad); at a break a new map begins, and lost frames show nothing."""
    generator = np.random.default_rng(seed)
    backend = Backend(sensors)
    before: int | None = None
    for index, pose in enumerate(truth):
        frame = PreparedFrame(index, str(index), index / RATE_HERTZ, None, None, "")
        if index in lost:
            backend.add_lost(frame, "shows nothing")
            before = None
        elif before is None or index in breaks:
            backend.begin_fragment(frame)
            before = index
        else:
            error = Pose2(*generator.normal(0.0, sigma, 3))
            motion = truth[before].inverse() @ pose @ error
            covariance = sigma**2 * np.eye(3)
            backend.place(frame, [Link(before, index, motion, covariance, 50, 0.9, "step")])
            before = index
    return backend


def feel_gps(
    sensors: Sensors,
    truth: list[Pose2],
    generator: np.random.Generator,
    sigma: float,
    outliers: float = 0.0,
    lever: Pose2 | None = None,
) -> None:
    places = np.array(
        [(p.x, p.y) for p in (EARTH_FROM_MAP @ t @ (lever or Pose2()) for t in truth)]
    )
    places += sigma * generator.standard_normal(places.shape)
    bad = generator.random(len(truth)) < outliers
    bearings = generator.uniform(0.0, math.tau, len(truth))
    places[bad] += 20.0 * np.column_stack([np.cos(bearings), np.sin(bearings)])[bad]
    for index, place in enumerate(geodetic_from_local(places, DATUM).tolist()):
        sensors.gps(GpsReading(index / RATE_HERTZ, *place, sigma))


def feel_compass(
    sensors: Sensors, truth: list[Pose2], generator: np.random.Generator, disturbed: slice
) -> None:
    headings = EARTH_FROM_MAP.theta + np.array([pose.theta for pose in truth])
    headings = headings + math.radians(4) + math.radians(3) * generator.standard_normal(len(truth))
    headings[disturbed] += math.radians(30)
    for index, heading in enumerate(headings.tolist()):
        sensors.compass(CompassReading(index / RATE_HERTZ, heading, math.radians(3)))


def rmse(backend: Backend, truth: list[Pose2]) -> float:
    """Root mean square distance after the best rigid alignment, metres."""
    found = pose_array([backend.graph.pose(i) for i in range(len(truth))])[:, :2] @ (1.0, 1j)
    known = pose_array(truth)[:, :2] @ (1.0, 1j)
    found, known = found - found.mean(), known - known.mean()
    turn = np.angle(np.vdot(found, known))
    return float(np.sqrt(np.mean(np.abs(np.exp(1j * turn) * found - known) ** 2)))


def earth_errors(backend: Backend, truth: list[Pose2]) -> np.ndarray:
    """How far from where they are on Earth the frames of fragment 0 are put, metres."""
    reference = backend.graph.georeferences[0]
    places = [reference.east_north_from_map @ backend.graph.pose(i) for i in range(len(truth))]
    true = pose_array([EARTH_FROM_MAP @ pose for pose in truth])[:, :2]
    plane = LocalPlane(reference.datum_degrees)
    known = [plane.east_north(*place) for place in geodetic_from_local(true, DATUM).tolist()]
    return np.hypot(*(pose_array(places)[:, :2] - known).T)


def test_metres_on_earth_are_those_of_the_ellipsoid() -> None:
    metres = np.array([[0.0, 0.0], [300.0, -200.0], [-800.0, 500.0]])
    plane = LocalPlane(DATUM)
    places = geodetic_from_local(metres, DATUM)
    found = [plane.east_north(*place) for place in places.tolist()]
    np.testing.assert_allclose(found, metres, atol=0.05)
    np.testing.assert_allclose(plane.geodetic(found), places, atol=1e-10)


def test_gps_and_compass_survive_outliers_and_place_the_map_on_earth() -> None:
    truth = winding(334, 0.3)
    for sigma in (0.001, 0.008):
        generator = np.random.default_rng(7)
        alone = drive(truth, Sensors(), 1, sigma)
        alone.solve()
        sensors = Sensors()
        fused = drive(truth, sensors, 1, sigma)
        feel_gps(sensors, truth, generator, 2.0, outliers=0.1)
        feel_compass(sensors, truth, generator, slice(100, 150))
        fused.solve()
        assert rmse(fused, truth) <= 1.1 * rmse(alone, truth)
        errors = earth_errors(fused, truth)
        assert math.sqrt(np.mean(errors**2)) < 0.5
        reference = fused.graph.georeferences[0]
        assert reference.readings == 334
        assert 20 <= reference.outliers <= 50
        sigmas = np.sqrt(np.diag(reference.covariance))
        away = EARTH_FROM_MAP.theta - reference.east_north_from_map.theta
        assert abs(away) < 3.0 * sigmas[2]
    # With steps so poor, vision alone is off by far more.
    assert rmse(fused, truth) < 0.5 * rmse(alone, truth)


def add_loops(backend: Backend, truth: list[Pose2]) -> None:
    """Four loop closures, the last of which is false by a metre and a radian."""
    for first in range(4):
        second = len(truth) - 1 - first
        error = Pose2(1.0, 1.0, 1.0) if first == 3 else Pose2()
        motion = truth[first].inverse() @ truth[second] @ error
        covariance = 1e-6 * np.eye(3)
        backend.graph.add_links([Link(first, second, motion, covariance, 50, 0.9, "loop")])


@pytest.mark.parametrize(
    ("frames", "wrong", "loops"),
    [(60, 0, False), (60, 3, False), (60, 3, True), (24, 3, True), (24, 5, False), (12, 3, True)],
)
def test_a_receiver_without_a_fix_and_wrong_fixes_at_the_start_are_outliers(
    frames: int, wrong: int, loops: bool
) -> None:
    truth, sensors = winding(frames, 0.3), Sensors()
    backend = drive(truth, sensors, 1, 0.001)
    if loops:
        add_loops(backend, truth)
    for place in ((0.0, 0.0), (90.0, 0.0), (-90.0, 180.0)):
        sensors.gps(GpsReading(0.0, *place, 0.05))
    places = np.array([(p.x, p.y) for p in (EARTH_FROM_MAP @ t for t in truth)])
    places[:wrong] += 1108.0
    for index, place in enumerate(geodetic_from_local(places, DATUM).tolist()):
        sensors.gps(GpsReading(index / RATE_HERTZ, *place, 0.05))
    backend.solve()
    reference = backend.graph.georeferences[0]
    assert reference.outliers == 3 + wrong
    errors = earth_errors(backend, truth)
    assert math.sqrt(np.mean(errors**2)) < 0.013
    assert errors.max() < (0.03 if frames == 60 and not loops else 0.013)
    assert len(backend.graph.switched_off) == int(loops)
    # As good as vision's path put on the right readings alone, by least squares.
    alone = drive(truth, Sensors(), 1, 0.001)
    if loops:
        add_loops(alone, truth)
    alone.solve()
    path = pose_array([alone.graph.pose(index) for index in range(frames)])[:, :2] @ (1.0, 1j)
    known = pose_array([EARTH_FROM_MAP @ pose for pose in truth])[:, :2] @ (1.0, 1j)
    centre, mean = path[wrong:].mean(), known[wrong:].mean()
    turn = np.angle(np.vdot(path[wrong:] - centre, known[wrong:] - mean))
    least_squares = np.abs(np.exp(1j * turn) * (path - centre) + mean - known)
    assert errors.max() < 1.02 * least_squares.max() + 1e-4


def test_readings_of_which_most_contradict_each_other_give_no_georeference() -> None:
    truth, sensors = winding(24, 0.3), Sensors()
    backend = drive(truth, sensors, 1, 0.001)
    generator = np.random.default_rng(1)
    places = np.array([(p.x, p.y) for p in (EARTH_FROM_MAP @ t for t in truth)])
    places[:16] += 200.0 * generator.standard_normal((16, 2))
    for index, place in enumerate(geodetic_from_local(places, DATUM).tolist()):
        sensors.gps(GpsReading(index / RATE_HERTZ, *place, 0.05))
    backend.solve()
    assert not backend.graph.georeferences


def test_a_sigma_of_zero_is_unknown() -> None:
    truth, known, unknown = winding(60, 0.3), Sensors(), Sensors()
    sigmas = {}
    for sensors, sigma in ((known, 3.0), (unknown, 0.0)):
        backend = drive(truth, sensors, 1, 0.001)
        feel_gps(sensors, truth, np.random.default_rng(1), sigma)
        backend.solve()
        sigmas[sigma] = float(backend.graph.georeferences[0].covariance[0, 0])
    assert sigmas[0.0] == pytest.approx(sigmas[3.0], rel=0.01)
    compass = CompassReading(0.0, 0.0, 0.0).with_sigma()
    assert compass.sigma_radians == pytest.approx(math.radians(3.0))


def test_a_track_across_the_180th_meridian_is_continuous() -> None:
    truth, sensors = winding(60, 0.3), Sensors()
    backend = drive(truth, sensors, 1, 0.001)
    places = np.array([(p.x, p.y) for p in (EARTH_FROM_MAP @ t for t in truth)])
    middle = places.mean(axis=0)
    for index, place in enumerate(geodetic_from_local(places - middle, (-17.0, 180.0)).tolist()):
        latitude, longitude = place
        longitude = (longitude + 180.0) % 360.0 - 180.0
        sensors.gps(GpsReading(index / RATE_HERTZ, latitude, longitude, 0.05))
    assert {math.copysign(1.0, reading.longitude_degrees) for reading in sensors._gps} == {1, -1}
    backend.solve()
    reference = backend.graph.georeferences[0]
    assert (reference.readings, reference.outliers) == (60, 0)
    east_north = reference.east_north_from_map
    first = EARTH_FROM_MAP @ truth[0]
    last = EARTH_FROM_MAP @ truth[-1]
    found = east_north @ backend.graph.pose(59)
    assert found.x - east_north.x == pytest.approx(last.x - first.x, abs=0.03)
    assert found.y - east_north.y == pytest.approx(last.y - first.y, abs=0.03)


def test_fused_with_gps_and_compass_a_drive_is_as_good_as_by_vision_alone() -> None:
    """Vision is so precise that poor readings change it by chance, by a few hundredths.

    On average they improve it all the same.
    """
    truth = winding(334, 0.3)
    ratios = []
    for seed in range(8):
        generator = np.random.default_rng(100 + seed)
        sensors = Sensors()
        alone, fused = (drive(truth, measured, seed, 0.0003) for measured in (Sensors(), sensors))
        feel_gps(sensors, truth, generator, 2.0, outliers=0.1)
        feel_compass(sensors, truth, generator, slice(100, 150))
        alone.solve()
        fused.solve()
        ratios.append(rmse(fused, truth) / rmse(alone, truth))
        assert math.sqrt(np.mean(earth_errors(fused, truth) ** 2)) < 0.5
    assert max(ratios) < 1.05
    assert np.mean(ratios) < 1.0


def test_a_large_map_is_corrected_at_a_cost_that_stays_flat(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = winding(900, 0.1)
    sensors = Sensors()
    generator = np.random.default_rng(7)
    feel_gps(sensors, truth, generator, 1.0, outliers=0.05)
    feel_compass(sensors, truth, generator, slice(0, 0))
    sizes: list[int] = []
    solve = posegraph.solve

    def counted(initial: dict[int, Pose2], *given: Any, **options: Any) -> posegraph.Solution:
        sizes.append(len(initial))
        return solve(initial, *given, **options)

    monkeypatch.setattr(posegraph, "solve", counted)
    streamed = drive(truth, sensors, 1, 0.001)
    assert max(sizes) < 500, "a large map is not solved as a whole before the end"
    assert sizes[-5:] == [51] * 5
    windows = streamed.graph.georeferences[0]
    assert windows.readings > 850
    # As good as a solution of the whole, within what is not known anyway.
    errors, latest = earth_errors(streamed, truth), streamed.graph[899].covariance
    assert latest is not None
    streamed.solve()
    whole = streamed.graph.georeferences[0]
    apart = windows.east_north_from_map.inverse() @ whole.east_north_from_map
    sigmas = np.sqrt(np.diag(windows.covariance))
    assert abs(apart.theta) < 3.0 * sigmas[2]
    assert apart.translation_length < 3.0 * max(sigmas[:2])
    assert math.sqrt(np.mean(errors**2)) < 0.5
    assert 0.9 < sigmas[2] / math.sqrt(whole.covariance[2, 2]) < 5.0
    ratio = np.diag(latest) / np.diag(streamed.graph[899].covariance)
    assert np.all((ratio > 0.9) & (ratio < 5.0))


def test_the_antenna_is_found_on_the_robot() -> None:
    # Not on a circle: there a robot whose antenna is ahead looks like one that is ahead itself.
    truth = [Pose2()]
    for index in range(150):
        truth.append(truth[-1] @ Pose2(0.2, 0.0, 0.3 * math.sin(0.15 * index)))
    lever = Pose2(0.4, -0.25)
    sensors = Sensors(TelemetryOptions(lever_arm_metres=None))
    feel_gps(sensors, truth, np.random.default_rng(3), 0.05, lever=lever)
    backend = drive(truth, sensors, 0, 0.001)
    backend.solve()
    assert backend.graph.georeferences[0].lever_arm_metres == pytest.approx((0.4, -0.25), abs=0.06)


def test_a_compass_alone_corrects_the_heading() -> None:
    truth = winding(300, 0.2)
    errors = []
    for fused in (False, True):
        sensors = Sensors()
        if fused:
            feel_compass(sensors, truth, np.random.default_rng(5), slice(0, 0))
        backend = drive(truth, sensors, 4, 0.01)
        backend.solve()
        errors.append(rmse(backend, truth))
        assert not backend.graph.georeferences
    assert errors[1] < 0.7 * errors[0]


def test_odometry_connects_what_lies_on_both_sides_of_a_gap() -> None:
    truth = winding(60, 0.1)
    lost = tuple(range(20, 40))
    apart = drive(truth, Sensors(), 0, 0.001, lost=lost)
    apart.solve()
    assert {e.fragment for e in apart.graph.estimates if e.map_from_robot} == {0, 1}
    for fed_before in (True, False):
        sensors = Sensors()
        readings = [
            OdometryReading(i / RATE_HERTZ, Pose2(5.0, 1.0, 2.0) @ pose)
            for i, pose in enumerate(truth)
        ]
        for reading in readings if fed_before else []:
            sensors.odometry(reading)
        backend = drive(truth, sensors, 0, 0.001, lost=lost)
        for reading in readings:
            sensors.odometry(reading)
        if fed_before:
            assert [backend.graph[i].status for i in lost] == ["predicted"] * 20
        backend.solve()
        assert {e.fragment for e in backend.graph.estimates} == {0}
        assert [backend.graph[i].status for i in lost] == ["predicted"] * 20
        assert all(backend.graph[i].status == "tracked" for i in range(60) if i not in lost)
        covariances = [backend.graph[i].covariance for i in (19, 30, 39)]
        assert all(covariance is not None for covariance in covariances)
        grown = [float(np.trace(c)) for c in covariances if c is not None]
        assert grown[0] < grown[1] < grown[2]
        assert rmse(backend, truth) < 0.02


def test_gps_connects_fragments_that_share_nothing() -> None:
    truth = winding(240, 0.3)
    sensors = Sensors()
    feel_gps(sensors, truth, np.random.default_rng(1), 0.5)
    backend = drive(truth, sensors, 0, 0.001, breaks=(120,))
    backend.solve()
    assert {e.fragment for e in backend.graph.estimates} == {0}
    assert rmse(backend, truth) < 0.4


def test_a_disturbed_odometry_does_not_move_what_the_frames_show() -> None:
    truth = winding(60, 0.1)
    sensors = Sensors()
    for index, pose in enumerate(truth):
        slipped = Pose2(1.5 if index > 30 else 0.0) @ pose
        sensors.odometry(OdometryReading(index / RATE_HERTZ, slipped))
    backend = drive(truth, sensors, 0, 0.001)
    backend.solve()
    assert rmse(backend, truth) < 0.02


CAMERA = CameraOptions(size=(400, 300), height_metres=0.2, pitch_degrees=45.0)


def paint_a_line(grid: slamcli.Grid) -> np.ndarray:
    y = grid.y_max - grid.metres_per_pixel * np.arange(grid.height)
    line = np.broadcast_to((np.abs(y - 0.03) < 0.012)[:, None], (grid.height, grid.width))
    gray = np.where(line, np.uint8(220), np.uint8(60))
    return np.ascontiguousarray(np.repeat(gray[..., None], 3, axis=2))


def test_a_plain_line_determines_the_heading_and_the_direction_across_it() -> None:
    floor = floors.BlockFloor(paint_a_line, 0.001)
    photographer = photograph.Photographer(photograph.World(floor), photograph.make_camera(CAMERA))
    truth = [
        Pose2(0.03 * i, 0.01 * math.sin(0.3 * i), 0.05 * math.sin(0.3 * i + 1)) for i in range(5)
    ]
    mapper = slamcli.Mapper(photographer.calibration)
    measured = Pose2()
    for index, pose in enumerate(truth):
        if index:
            step = truth[index - 1].inverse() @ pose
            measured = measured @ Pose2(1.02 * step.x, 1.02 * step.y, step.theta + 0.01)
        mapper.odometry(OdometryReading(0.2 * index, measured))
        generator = np.random.default_rng(index)
        still = (pose, pose)
        picture = photograph.take(photographer, still, 0.0, DisturbanceOptions(), generator)
        mapper.update(slamcli.Frame(index, str(index), 0.2 * index, picture))
    streamed = mapper.estimates
    for estimates in (streamed, mapper.finish()):
        assert {e.status for e in estimates[1:]} == {"predicted"}
        for estimate, pose in zip(estimates, truth, strict=True):
            assert estimate.map_from_robot is not None
            off = (truth[0].inverse() @ pose).inverse() @ estimate.map_from_robot
            line = -pose.theta
            across = -off.x * math.sin(line) + off.y * math.cos(line)
            assert abs(across) < 0.001
            assert abs(math.degrees(off.theta)) < 0.05
    assert {link.kind for link in mapper.links} == {"partial"}


def test_ten_metres_of_blank_floor_are_bridged_by_odometry() -> None:
    floor = floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3)
    photographer = photograph.Photographer(photograph.World(floor), photograph.make_camera(CAMERA))
    along = [0.05 * i for i in range(4)]
    along += [along[-1] + 0.5 * (i + 1) for i in range(20)]
    bare = range(4, len(along) - 1)
    along += [along[-1] + 0.05 * (i + 1) for i in range(4)]
    truth = [Pose2(x, 0.02 * x * x, 0.04 * x) for x in along]
    measured = [Pose2()]
    for before, after in pairwise(truth):
        step = before.inverse() @ after
        drift = 0.004 * step.translation_length
        measured.append(measured[-1] @ Pose2(1.02 * step.x, 1.02 * step.y, step.theta + drift))
    mapper = slamcli.Mapper(photographer.calibration)
    streamed = []
    for index, pose in enumerate(truth):
        generator = np.random.default_rng(index)
        noise = 120.0 + 2.0 * generator.standard_normal((300, 400, 3))
        picture = np.clip(noise, 0, 255).astype(np.uint8)
        if index not in bare:
            still = (pose, pose)
            picture = photograph.take(photographer, still, 0.0, DisturbanceOptions(), generator)
        mapper.odometry(OdometryReading(0.2 * index, measured[index]))
        streamed.append(mapper.update(slamcli.Frame(index, str(index), 0.2 * index, picture)))
    assert {streamed[index].status for index in bare} == {"predicted"}
    odom = [e.odom_from_robot for e in streamed if e.odom_from_robot is not None]
    assert len(odom) == len(truth)
    longest = max((a.inverse() @ b).translation_length for a, b in pairwise(odom))
    assert longest < 0.6
    final = mapper.finish()
    assert {final[index].status for index in bare} == {"predicted"}
    assert [e.status for e in final[bare.stop :]] == ["tracked"] * (len(final) - bare.stop)
    for estimate, pose in zip(final[1:], truth[1:], strict=True):
        assert estimate.fragment == 0
        assert estimate.map_from_robot is not None
        assert estimate.covariance is not None
        error = pose.inverse() @ estimate.map_from_robot
        sigmas = np.sqrt(np.diag(estimate.covariance)) + 1e-3
        assert np.all(np.abs([error.x, error.y, error.theta]) < 3.0 * sigmas)
    assert final[-1].covariance is not None
    assert math.sqrt(final[-1].covariance[0, 0]) < 0.5


@pytest.fixture(scope="module")
def drive_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from slamcli.run.session.session import Session
    from slamcli.run.simulate import simulate

    folder = tmp_path_factory.mktemp("drive") / "drive"
    turns = [0.3 * math.sin(0.9 * index) for index in range(25)]
    poses = [Pose2()]
    for turn in turns:
        poses.append(poses[-1] @ Pose2(0.045 + 0.1 * abs(turn), 0.0, turn))
    rows = [f"{pose.x},{pose.y},{pose.theta}" for pose in poses]
    way = folder.parent / "way.csv"
    way.write_text("\n".join(["x,y,heading", *rows]) + "\n")
    options = SimulationOptions(
        path=str(way), camera=CameraOptions(size=(320, 240)), imaging=ImagingOptions(light=False)
    )
    simulate(folder, options, overwrite=False, session=Session())
    return folder


def stitch(folder: Path, output: Path, *options: str) -> str:
    command = ["stitch", str(folder / "frames"), "-c", str(folder / "camera.yaml")]
    command += ["-o", str(output), "--frame-rate", "10", *options]
    result = CliRunner().invoke(main, command)
    return f"{result.exit_code} {result.output}"


def test_stitch_uses_the_sensors(drive_folder: Path, tmp_path: Path) -> None:
    # Survey-grade, as the drive is short.
    truth = read_trajectory(drive_folder / "truth.csv")
    assert truth.stamps is not None
    exact = geodetic_from_local(truth.poses[:, :2], DATUM)
    write_gps(tmp_path / "gps.csv", truth.stamps.tolist(), exact, 0.01)
    sensors = [f"--{name}={drive_folder / name}.csv" for name in ("odometry", "compass")]
    sensors += [f"--gps={tmp_path / 'gps.csv'}", "--time-offset", "auto"]
    frames = tmp_path / "drive" / "frames"
    shutil.copytree(drive_folder / "frames", frames)
    shutil.copy(drive_folder / "camera.yaml", frames.parent)
    (frames / "0012.jpg").write_bytes(b"no picture")
    output = tmp_path / "out"
    sensors += ["--format", "png,geotiff"]
    printed = stitch(frames.parent, output, *sensors, "--export", "geojson,links,g2o")
    assert printed.startswith("0"), printed
    run = tomllib.loads((output / "run.toml").read_text())
    assert run["georeference"]["gps_readings"] >= 22
    assert run["georeference"]["x_axis_degrees_from_east"] == pytest.approx(0.0, abs=3.0)
    assert run["gps"].endswith("gps.csv")
    track = json.loads((output / "track.geojson").read_text())
    longitude, latitude = track["features"][0]["geometry"]["coordinates"][0]
    assert (latitude, longitude) == pytest.approx(DATUM, abs=3e-7)
    # The picture lies on Earth where the floor of the drive does, north up.
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(output / "mosaic.tif") as picture:
        system, transform, bounds = picture.crs, picture.transform, picture.bounds
    assert system.to_epsg() is not None
    assert (transform.b, transform.d) == (0.0, 0.0)
    warp = pytest.importorskip("rasterio.warp")
    (east,), (north,) = warp.transform("EPSG:4326", system, [DATUM[1]], [DATUM[0]])
    # The drive is short, and the camera sees less than 2 m far.
    assert bounds.left - 2.0 < east < bounds.right + 2.0
    assert bounds.bottom - 2.0 < north < bounds.top + 2.0
    assert max(bounds.right - bounds.left, bounds.top - bounds.bottom) < 10.0
    links = (output / "links.csv").read_text().splitlines()
    assert links[0].startswith("a,b,kind")
    # Odometry between all frames that follow one another, besides.
    assert (output / "graph.g2o").read_text().count("EDGE_SE2") == len(links) - 1 + 25
    assert "predicted    1, carried by odometry" in printed
    rows = (output / "poses.csv").read_text().splitlines()
    assert rows[13].split(",")[3] == "predicted"
    assert "on Earth     origin known to 0.0" in printed
    assert re.search(r"time offset +[+-]0\.0\d\d s", printed)


def test_stitch_says_what_it_lacks(
    drive_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = stitch(drive_folder, tmp_path / "a", "--export", "geojson")
    assert refused.startswith("1 Error: --export geojson needs --gps")
    refused = stitch(drive_folder, tmp_path / "b", "--time-offset", "auto")
    assert refused.startswith("1 Error: --time-offset auto needs --odometry")
    assert stitch(drive_folder, tmp_path / "d", "--lever-arm", "1").startswith("2")
    plain = ["stitch", str(drive_folder / "frames"), "-o", str(tmp_path / "f"), "--frame-rate=10"]
    refused = CliRunner().invoke(main, [*plain, f"--gps={drive_folder / 'gps.csv'}"]).output
    assert "the frames are in pixels; give --calibration" in refused
    monkeypatch.setitem(sys.modules, "pyproj", None)
    refused = stitch(drive_folder, tmp_path / "e", f"--gps={drive_folder / 'gps.csv'}")
    assert "1 Error: GPS needs pyproj: pip install slamcli[geo]" in refused
    assert not list(tmp_path.iterdir())
