"""Exports of `slam stitch --export`: trajectories, pose graph and track, for other tools."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from slamcli.core.config import Datum
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.io.frames import FrameFile
from slamcli.io.g2o import write_g2o, write_links
from slamcli.io.geojson import write_geojson
from slamcli.io.toml import Scalar
from slamcli.io.trajectories import write_kitti, write_tum
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.mapping.backend.sensors import Sensors
from slamcli.selfcal import RegisteredDrive
from slamcli.stages.geodesy import LocalPlane, project_map, projection

PRODUCTS = ("trajectory*.tum", "trajectory*.kitti", "graph*.g2o", "track.geojson", "links.csv")


def check_exports(kinds: Sequence[str], files: Sequence[FrameFile], *, has_gps: bool) -> None:
    """Refuse, before the work, what could not be written after it; raises InputError."""
    unstamped = next((file for file in files if file.stamp is None), None)
    if "tum" in kinds and unstamped is not None:
        raise InputError(
            f"{unstamped.path} has no stamp, which --export tum needs; give --frame-rate"
        )
    if "geojson" in kinds and not has_gps:
        raise InputError("--export geojson needs --gps, which places the track on Earth")


def write_exports(
    folder: Path,
    kinds: Sequence[str],
    found: RegisteredDrive,
    sensors: Sensors,
    georeferences: Mapping[int, Georeference],
) -> None:
    """Write the exports of these kinds, a file for each fragment, or one for all."""
    fragments = placed_fragments(found.estimates)
    off = found.switched_off
    links = [link for number, link in enumerate(found.links) if number not in off]
    links += sensors.chain(found.estimates)
    for fragment, members in fragments.items():
        suffix = "" if fragment == 0 else f"_{fragment}"
        for kind in kinds:
            if kind in EXPORTS:
                EXPORTS[kind](folder, suffix, members, links)
    if "links" in kinds:
        write_links(folder / "links.csv", found.links, off)
    if "geojson" in kinds:
        tracks = {}
        for fragment, on_earth in georeferences.items():
            poses = pose_array(list(_poses(fragments[fragment]).values()))
            places = on_earth.east_north_from_map.apply(poses[:, :2])
            tracks[fragment] = LocalPlane(on_earth.datum_degrees).geodetic(places)
        write_geojson(folder / "track.geojson", tracks)


def datums(georeferences: Mapping[int, Georeference]) -> dict[int, Datum]:
    """Return the origin on Earth of every fragment with enough GPS readings."""
    return {fragment: _datum(found) for fragment, found in georeferences.items()}


def _datum(found: Georeference) -> Datum:
    pose, plane = found.east_north_from_map, LocalPlane(found.datum_degrees)
    latitude, longitude = plane.geodetic([(pose.x, pose.y)])[0].tolist()
    return Datum(latitude, longitude, pose.theta)


def georeference_table(found: Georeference, crs: str) -> dict[str, Scalar]:
    """Return a map's place on Earth as a table of run.toml: degrees and metres.

    Parameters
    ----------
    crs : str
        The system that GeoTIFFs are written in; empty or ``auto`` for the UTM zone.
    """
    pose, sigmas = found.east_north_from_map, np.sqrt(np.diag(found.covariance))
    return {
        "datum_latitude_degrees": found.datum_degrees[0],
        "datum_longitude_degrees": found.datum_degrees[1],
        "projection": projection(found.datum_degrees),
        **_projected(found, crs),
        "origin_east_metres": pose.x,
        "origin_north_metres": pose.y,
        "x_axis_degrees_from_east": math.degrees(pose.theta),
        "origin_east_sigma_metres": float(sigmas[0]),
        "origin_north_sigma_metres": float(sigmas[1]),
        "x_axis_sigma_degrees": math.degrees(sigmas[2]),
        "lever_arm_ahead_metres": found.lever_arm_metres[0],
        "lever_arm_left_metres": found.lever_arm_metres[1],
        "gps_readings": found.readings,
        "gps_outliers": found.outliers,
    }


def _projected(found: Georeference, crs: str) -> dict[str, Scalar]:
    """Return the map's place in the system that GeoTIFFs are written in."""
    placed = project_map(_datum(found), crs)
    east, north = placed.projected_from_map[:2, 2].tolist()
    return {
        "crs": placed.crs,
        "crs_origin_east_metres": east,
        "crs_origin_north_metres": north,
        "crs_x_axis_degrees_from_east": math.degrees(placed.turn_radians),
    }


def describe(found: Georeference) -> str:
    """Return the accuracy of a map's place on Earth, as a line."""
    sigmas = np.sqrt(np.diag(found.covariance))
    return (
        f"origin known to {max(sigmas[:2]):.2g} m, direction to {math.degrees(sigmas[2]):.2g} "
        f"degrees, by {found.readings} GPS readings, {found.outliers} of them outliers"
    )


def _tum(
    folder: Path, suffix: str, members: Sequence[PoseEstimate], _links: Sequence[Link]
) -> None:
    stamps = [member.stamp for member in members if member.stamp is not None]
    write_tum(folder / f"trajectory{suffix}.tum", stamps, list(_poses(members).values()))


def _kitti(
    folder: Path, suffix: str, members: Sequence[PoseEstimate], _links: Sequence[Link]
) -> None:
    write_kitti(folder / f"trajectory{suffix}.kitti", list(_poses(members).values()))


def _g2o(folder: Path, suffix: str, members: Sequence[PoseEstimate], links: Sequence[Link]) -> None:
    write_g2o(folder / f"graph{suffix}.g2o", _poses(members), links)


def _poses(members: Sequence[PoseEstimate]) -> dict[int, Pose2]:
    return {m.index: m.map_from_robot for m in members if m.map_from_robot is not None}


EXPORTS: dict[str, Callable[[Path, str, Sequence[PoseEstimate], Sequence[Link]], None]] = {
    "tum": _tum,
    "kitti": _kitti,
    "g2o": _g2o,
}
