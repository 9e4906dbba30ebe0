"""How odometry, compass and GPS agree with the map that the pictures give."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.mapping.backend.sensors import Sensors
from slamcli.run.report.frames import link_residuals
from slamcli.run.report.run import FinishedRun

# Readings farther from the map than this many sigmas are counted apart.
_FAR_SIGMAS = 5.0
_MAX_DRAWN = 5000


def sensor_agreement(run: FinishedRun) -> dict[str, object]:
    """Return rows of name and text, and the GPS readings to be drawn.

    Each of those is the fragment, where the antenna was by the map and by the reading (in the
    map's axes), and 1 when they are far apart.
    """
    fragments, sensors = placed_fragments(run.estimates), run.mapper.sensors
    rows = [
        *_odometry_rows(sensors, fragments),
        *_compass_rows(sensors, fragments),
    ]
    drawn = list[list[float]]()
    for fragment, on_earth in run.georeferences.items():
        places, sigmas = _gps_places(sensors, fragments[fragment], on_earth)
        if len(places):
            rows.append(_gps_row(places, sigmas))
            far = _distances(places) > _FAR_SIGMAS * sigmas
            for place, apart in zip(places.round(4).tolist(), far.tolist(), strict=True):
                drawn.append([fragment, *place, int(apart)])
    step = -(-len(drawn) // _MAX_DRAWN) or 1
    return {"rows": rows, "gps": drawn[::step]}


def _odometry_rows(
    sensors: Sensors, fragments: Mapping[int, Sequence[PoseEstimate]]
) -> list[list[str]]:
    """Return how each motion by odometry, from frame to frame, fits the map's."""
    links, fragment_of = [], {m.index: f for f, own in fragments.items() for m in own}
    for members in fragments.values():
        links += [
            link for link in sensors.chain(members) if fragment_of[link.a] == fragment_of[link.b]
        ]
    if not links:
        return []
    estimates = [one for members in fragments.values() for one in members]
    residuals = link_residuals(links, estimates)
    poses = {one.index: one.map_from_robot for one in estimates}
    by_map = sum(_distance(poses[link.a], poses[link.b]) for link in links)
    by_odometry = sum(link.a_from_b.translation_length for link in links)
    longer = 100.0 * (by_odometry / by_map - 1.0) if by_map > 0 else 0.0
    rms = np.sqrt(np.mean(residuals[:, :2] ** 2, axis=0))
    far = int(np.count_nonzero(residuals[:, 2] > _FAR_SIGMAS))
    text = (
        f"{len(links)} motions: {1000.0 * rms[0]:.1f} mm and {math.degrees(rms[1]):.2f}° (rms) "
        f"from the map's, {abs(longer):.1f} % {'longer' if longer >= 0 else 'shorter'} than it, "
        f"{_far_text(far)}"
    )
    return [["odometry", text]]


def _distance(first: Pose2 | None, second: Pose2 | None) -> float:
    assert first is not None
    assert second is not None
    return (first.inverse() @ second).translation_length


def _compass_rows(
    sensors: Sensors, fragments: Mapping[int, Sequence[PoseEstimate]]
) -> list[list[str]]:
    rows = []
    for fragment, members in fragments.items():
        poses = {m.index: m.map_from_robot for m in members if m.map_from_robot is not None}
        readings = [r for r in sensors.headings(members) if r.frame in poses]
        if len(readings) < 2:
            continue
        angles = np.array(
            [r.heading_radians - (poses[r.frame] @ r.frame_from_robot).theta for r in readings]
        )
        sigmas = np.array([r.sigma_radians for r in readings])
        # The median direction: outliers do not turn it.
        start = float(np.angle(np.mean(np.exp(1j * angles))))
        errors = (angles - start + math.pi) % math.tau - math.pi
        errors -= np.median(errors)
        rms = math.degrees(float(np.sqrt(np.mean(errors**2))))
        far = int(np.count_nonzero(np.abs(errors) > _FAR_SIGMAS * sigmas))
        text = f"{len(readings)} readings: {rms:.2f}° (rms) from the map's headings, "
        rows.append([_name("compass", fragment), text + _far_text(far)])
    return rows


def _gps_places(
    sensors: Sensors, members: Sequence[PoseEstimate], on_earth: Georeference
) -> tuple[Float64Array, Float64Array]:
    """Return (N, 4) places of the antenna by the map and by the readings, and (N,) their sigmas."""
    poses = {m.index: m.map_from_robot for m in members if m.map_from_robot is not None}
    map_from_east_north = on_earth.east_north_from_map.inverse()
    places, sigmas = [], []
    for reading in sensors.positions(members):
        pose = poses.get(reading.frame)
        if pose is None:
            continue
        by_map = (pose @ reading.frame_from_robot).apply(on_earth.lever_arm_metres)
        by_reading = map_from_east_north.apply((reading.east_metres, reading.north_metres))
        places.append([*by_map.tolist(), *by_reading.tolist()])
        sigmas.append(reading.sigma_metres)
    return np.array(places).reshape(-1, 4), np.array(sigmas)


def _gps_row(places: Float64Array, sigmas: Float64Array) -> list[str]:
    distances = _distances(places)
    far = int(np.count_nonzero(distances > _FAR_SIGMAS * sigmas))
    text = (
        f"{len(places)} readings: median {np.median(distances):.2f} m from the map, farthest "
        f"{distances.max():.2f} m, {_far_text(far)}"
    )
    return ["GPS", text]


def _distances(places: Float64Array) -> Float64Array:
    return np.asarray(np.hypot(*(places[:, :2] - places[:, 2:]).T), np.float64)


def _far_text(count: int) -> str:
    return f"{count} of them farther than {_FAR_SIGMAS:g} sigmas"


def _name(sensor: str, fragment: int) -> str:
    return sensor if fragment == 0 else f"{sensor}, map {fragment + 1}"
