"""A survey on Earth: its scale, direction and place by what the cameras noted in its photos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Rocking
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import GPS_SIGMA_METRES, Georeference
from slamcli.io.frames import FrameFile
from slamcli.io.images.photo import PhotoInfo
from slamcli.io.picture_files import photo_info_of
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.stitch.drive import LocatedDrive, SurveyFacts
from slamcli.selfcal import RegisteredDrive
from slamcli.stages.geodesy import LocalPlane
from slamcli.survey.ground import Ground, below_camera, fit_ground

# A photo that looks farther off straight down shows the ground in perspective, and what stands on
# it. [guarded by tests/run/stitch/test_photos.py]
_MAX_OFF_NADIR_DEGREES = 20.0
# Photos whose notes are read to find whether most have a place: a receiver needs a while at first.
_ASKED = 9


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """The scale of a fragment, and its place where that is known."""

    metres_per_unit: float
    ground: Ground | None = None


def geotagged(files: Sequence[FrameFile]) -> bool:
    """Return whether most photos note where they were taken: then they are those of a survey."""
    some = sorted({round(share * (len(files) - 1)) for share in np.linspace(0.0, 1.0, _ASKED)})
    placed = [photo_info_of(files[number].path).place_degrees is not None for number in some]
    return 2 * sum(placed) > len(placed)


def on_earth(located: LocatedDrive) -> LocatedDrive:
    """Return a survey in metres, with its place on Earth, as far as its photos determine them.

    Raises
    ------
    InputError
        When photos have places and pyproj is not installed.
    """
    if located.survey is None or located.calibration.unit != "px":
        return located
    files = located.drive.inputs.files
    infos = [photo_info_of(file.path) for file in files]
    fixes = [info.place_degrees for info in infos]
    datum = next((place for place in fixes if place is not None), None)
    plane = None if datum is None else LocalPlane(datum)
    scales = dict[int, _Scale]()
    for fragment, members in placed_fragments(located.registered.estimates).items():
        scale = _scale_of(members, infos, plane, located)
        if scale is not None:
            scales[fragment] = scale
    if not scales:
        return _with_row(located, _unknown(infos), {})
    first = next(iter(scales.values())).metres_per_unit
    georeferences, turns = dict[int, Georeference](), dict[int, float]()
    for fragment, scale in scales.items():
        if scale.ground is not None and datum is not None:
            turns[fragment] = scale.ground.east_north_from_map.theta
            georeferences[fragment] = _georeference(scale.ground, datum, turns[fragment])
    registered = in_metres(
        _turned(located.registered, turns),
        {fragment: scale.metres_per_unit for fragment, scale in scales.items()},
        first,
    )
    found = replace(located, registered=registered, on_earth=georeferences)
    found = _with_row(found, *_described(scales, infos, located))
    return _with_row(found, *_gimbal(found, infos), name="gimbal")


def _scale_of(
    members: Sequence[PoseEstimate],
    infos: Sequence[PhotoInfo],
    plane: LocalPlane | None,
    located: LocatedDrive,
) -> _Scale | None:
    """Return the scale of a fragment by its places, else by the heights of its photos."""
    focal = float(located.calibration.camera_matrix[0, 0])
    points, places, sigmas = list[tuple[float, float]](), list[tuple[float, float]](), list[float]()
    for one in members:
        info = infos[one.index]
        if plane is None or info.place_degrees is None or one.map_from_robot is None:
            continue
        points.append(below_camera(one.map_from_robot, one.rocking or Rocking(), focal))
        places.append(plane.east_north(*info.place_degrees))
        sigmas.append(info.place_sigma_metres or GPS_SIGMA_METRES)
    if points:
        ground = fit_ground(np.array(points), np.array(places), np.array(sigmas))
        if ground is not None:
            return _Scale(ground.metres_per_unit, ground)
    by_height = _scale_by_height(members, infos, located)
    return None if by_height is None else _Scale(by_height)


def _scale_by_height(
    members: Sequence[PoseEstimate], infos: Sequence[PhotoInfo], located: LocatedDrive
) -> float | None:
    """Return metres a unit of the map by heights above the take-off and focal lengths in EXIF."""
    nominal = float(located.calibration.camera_matrix[0, 0])
    found = []
    for one in members:
        info = infos[one.index]
        focal = info.focal_pixels(located.calibration.image_size)
        height = info.relative_altitude_metres
        if focal is not None and height is not None and height > 0.0:
            units = 1.0 + (one.rocking or Rocking()).height_metres / nominal
            found.append(height / (focal * units))
    return float(np.median(found)) if found else None


def _georeference(ground: Ground, datum: tuple[float, float], turn: float) -> Georeference:
    """Return the place of a map that was turned."""
    count, used = len(ground.inliers), int(ground.inliers.sum())
    pose = ground.east_north_from_map
    place = Pose2(pose.x, pose.y, pose.theta - turn)
    return Georeference(datum, place, ground.covariance, (0.0, 0.0), count, count - used)


def _turned(registered: RegisteredDrive, turns: Mapping[int, float]) -> RegisteredDrive:
    """Return a survey whose maps are turned about their origins: x to the east."""
    poses = {
        one.index: Pose2(0.0, 0.0, turns[one.fragment]) @ one.map_from_robot
        for one in registered.estimates
        if one.fragment in turns and one.map_from_robot is not None
    }
    estimates = [
        replace(one, map_from_robot=poses[one.index]) if one.index in poses else one
        for one in registered.estimates
    ]
    return replace(registered, estimates=estimates)


def in_metres(
    registered: RegisteredDrive, metres_per_unit: Mapping[int, float], first: float
) -> RegisteredDrive:
    """Return a survey in metres; a fragment without a scale of its own has the first one's."""
    camera = registered.calibration
    focal = float(camera.camera_matrix[0, 0])
    stretch = np.diag([first, first, 1.0])
    camera = replace(
        camera,
        unit="m",
        robot_from_image=stretch @ camera.robot_from_image,
        max_range_metres=first * camera.max_range_metres,
    )
    scale_of = {one.index: metres_per_unit.get(one.fragment, first) for one in registered.estimates}
    estimates = [_scaled(one, scale_of[one.index], first, focal) for one in registered.estimates]
    links = [_scaled_link(link, scale_of[link.a]) for link in registered.links]
    floor_map = registered.floor_map
    if floor_map is not None:
        floor_map = replace(
            floor_map,
            calibration=camera,
            metres_per_pixel=first * floor_map.metres_per_pixel,
            estimates=tuple(estimates),
            links=tuple(links),
        )
    return replace(
        registered, calibration=camera, estimates=estimates, links=links, floor_map=floor_map
    )


def _scaled(one: PoseEstimate, scale: float, first: float, focal: float) -> PoseEstimate:
    """Return an estimate in metres; the height is that above the first fragment's camera."""
    if one.map_from_robot is None:
        return one
    rocking = one.rocking or Rocking()
    height = scale * (focal + rocking.height_metres) - first * focal
    return replace(
        one,
        map_from_robot=_scaled_pose(one.map_from_robot, scale),
        covariance=None if one.covariance is None else _scaled_covariance(one.covariance, scale),
        rocking=replace(rocking, height_metres=height),
    )


def _scaled_link(link: Link, scale: float) -> Link:
    return replace(
        link,
        a_from_b=_scaled_pose(link.a_from_b, scale),
        covariance=_scaled_covariance(link.covariance, scale),
    )


def _scaled_pose(pose: Pose2, scale: float) -> Pose2:
    return Pose2(scale * pose.x, scale * pose.y, pose.theta)


def _scaled_covariance(covariance: Float64Array, scale: float) -> Float64Array:
    stretch = np.diag([scale, scale, 1.0])
    return stretch @ covariance @ stretch


def _described(
    scales: Mapping[int, _Scale], infos: Sequence[PhotoInfo], located: LocatedDrive
) -> tuple[str, dict[str, float]]:
    """Return the row on the scale, and the same for run.toml."""
    fragment, scale = next(iter(scales.items()))
    members = placed_fragments(located.registered.estimates)[fragment]
    by_height = _scale_by_height(members, infos, located)
    section = {"metres_per_unit": scale.metres_per_unit}
    if scale.ground is None:
        return f"{scale.metres_per_unit:.4g} m a pixel by the heights of the photos", section
    used, count = int(scale.ground.inliers.sum()), len(scale.ground.inliers)
    section["scale_sigma_share"] = scale.ground.scale_sigma_share
    text = (
        f"{scale.metres_per_unit:.4g} m a pixel, sigma {scale.ground.scale_sigma_share:.1%}, "
        f"by the GPS of {used} of {count} photos"
    )
    if by_height is not None:
        section["metres_per_unit_by_height"] = by_height
        text += f"; {by_height:.4g} by their heights"
    return text, section


def _gimbal(located: LocatedDrive, infos: Sequence[PhotoInfo]) -> tuple[str, dict[str, float]]:
    """Return the row on the gimbal's angles, against the map's, and the same for run.toml.

    The picture's up is the gimbal's yaw; it lies a quarter turn from the x axis of a pose.
    """
    tilted = sum(
        info.pitch_degrees is not None and info.pitch_degrees > _MAX_OFF_NADIR_DEGREES - 90.0
        for info in infos
    )
    turns = [
        math.radians(info.yaw_degrees) + located.on_earth[one.fragment].east_north_from_map.theta
        + one.map_from_robot.theta
        for one in located.registered.estimates
        if (info := infos[one.index]).yaw_degrees is not None
        and one.fragment in located.on_earth
        and one.map_from_robot is not None
    ]  # fmt: skip
    texts, section = list[str](), dict[str, float]()
    if turns:
        apart = np.exp(1j * np.array(turns))
        median = float(np.median(np.angle(apart, deg=True)))
        section["gimbal_yaw_off_degrees"] = median
        texts.append(f"yaw {median:+.1f}° from the map's direction by GPS, median of {len(turns)}")
    if tilted:
        texts.append(
            f"{tilted} of {len(infos)} photos look more than {_MAX_OFF_NADIR_DEGREES:g}° off "
            "straight down; leave them out"
        )
    return "; ".join(texts), section


def _unknown(infos: Sequence[PhotoInfo]) -> str:
    """Return why the scale is not known; empty when no photo could tell."""
    count = sum(info.place_degrees is not None for info in infos)
    if not count:
        return ""
    return f"not known: the GPS of {count} photos is too uncertain for how far apart they are"


def _with_row(
    located: LocatedDrive, text: str, section: Mapping[str, float], name: str = "scale"
) -> LocatedDrive:
    """Return the drive with one more row on its survey."""
    if located.survey is None or not text:
        return located
    rows = (*located.survey.rows, (name, text))
    facts = SurveyFacts(rows, {**located.survey.section, **section})
    assert all(map(math.isfinite, section.values()))
    return replace(located, survey=facts)
