"""Applies an adjustment to a registered drive: camera, poses, rocking and links, in metres."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.footprint import choose_max_range
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.selfcal.bundle import RegisteredDrive
from slamcli.stages import adjustment

# Smallest covariance of a pose, m and rad: that of a map's first frame is zero.
_MIN_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])


def apply_adjustment(
    drive: RegisteredDrive, found: adjustment.Adjustment, scale: float
) -> RegisteredDrive:
    """Return the drive with adjusted camera and poses, all lengths multiplied by `scale`.

    A frame without matches of its own moves with the nearest adjusted one of its map. A link
    between two adjusted frames becomes the motion between their poses.
    """
    calibration = _scaled_camera(found, drive.calibration, scale)
    before = {e.index: e for e in drive.estimates if e.map_from_robot is not None}
    estimates = []
    for estimate in drive.estimates:
        if estimate.map_from_robot is None:
            estimates.append(estimate)
            continue
        rocking, covariance = Rocking(), estimate.covariance
        if estimate.index in found.poses:
            pose = found.poses[estimate.index].map_from_robot
            rocking = found.poses[estimate.index].rocking
            covariance = found.pose_covariances[estimate.index] + _MIN_POSE_COVARIANCE
        else:
            pose = _moved_with_nearest(estimate, before, found)
        metres = np.array([scale, scale, 1.0])
        estimates.append(
            replace(
                estimate,
                map_from_robot=Pose2(scale * pose.x, scale * pose.y, pose.theta),
                covariance=None if covariance is None else covariance * np.outer(metres, metres),
                rocking=replace(rocking, height_metres=scale * rocking.height_metres),
            )
        )
    by_index = {estimate.index: estimate for estimate in estimates}
    floor_map = drive.floor_map
    if floor_map is not None:
        kept = tuple(by_index[estimate.index] for estimate in floor_map.estimates)
        links = tuple(_adjusted(link, found, scale) for link in floor_map.links)
        floor_map = replace(floor_map, calibration=calibration, estimates=kept, links=links)
    return replace(
        drive,
        calibration=calibration,
        estimates=estimates,
        links=[
            _scaled(link, scale) if number in drive.switched_off else _adjusted(link, found, scale)
            for number, link in enumerate(drive.links)
        ],
        floor_map=floor_map,
    )


def _adjusted(link: Link, found: adjustment.Adjustment, scale: float) -> Link:
    """Return a link as the adjusted poses of its frames have it, its lengths multiplied."""
    if link.kind in ("step", "loop") and link.a in found.poses and link.b in found.poses:
        a, b = (found.poses[index].map_from_robot for index in (link.a, link.b))
        link = replace(link, a_from_b=a.inverse() @ b)
    return _scaled(link, scale)


def _scaled(link: Link, scale: float) -> Link:
    """Return a link with its lengths multiplied by `scale`."""
    motion, metres = link.a_from_b, np.array([scale, scale, 1.0])
    return replace(
        link,
        a_from_b=Pose2(scale * motion.x, scale * motion.y, motion.theta),
        covariance=link.covariance * np.outer(metres, metres),
    )


def with_range(before: Calibration, calibration: Calibration) -> Calibration:
    """Return a calibration with the range of the one before, scaled as its view of the floor is."""
    chosen = [
        choose_max_range(c.camera_matrix, c.image_from_robot, c.image_size)
        for c in (before, calibration)
    ]
    return replace(calibration, max_range_metres=before.max_range_metres * chosen[1] / chosen[0])


def describe_change(before: Calibration, after: Calibration) -> str:
    """Return in words how the camera was changed."""
    focal = [c.camera_matrix[0, 0] for c in (before, after)]
    height = [1000.0 * c.height_metres for c in (before, after)]
    pitch = [math.degrees(c.pitch_radians) for c in (before, after)]
    roll = [math.degrees(c.roll_radians) for c in (before, after)]
    lens = [", ".join(f"{k:.4f}" for k in c.distortion[:2]) for c in (before, after)]
    centre = after.camera_matrix[:2, 2] - before.camera_matrix[:2, 2]
    return (
        f"focal length {focal[0]:.1f} to {focal[1]:.1f} ± {after.focal_sigma_pixels:.1f} px, "
        f"radial distortion {lens[0]} to {lens[1]}, "
        f"principal point moved by {centre[0]:.1f}, {centre[1]:.1f} px, "
        f"{'' if after.unit == 'h' else f'height {height[0]:.1f} to {height[1]:.1f} mm, '}"
        f"pitch {pitch[0]:.2f} to {pitch[1]:.2f} ± {math.degrees(after.pitch_sigma_radians):.2g}°, "
        f"roll {roll[0]:.2f} to {roll[1]:.2f} ± {math.degrees(after.roll_sigma_radians):.2g}°"
    )


def _moved_with_nearest(
    estimate: PoseEstimate, before: Mapping[int, PoseEstimate], found: adjustment.Adjustment
) -> Pose2:
    """Return a frame's pose moved as the nearest adjusted frame of its map was."""
    assert estimate.map_from_robot is not None
    same = [i for i in found.poses if before[i].fragment == estimate.fragment]
    if not same:
        return estimate.map_from_robot
    nearest = min(same, key=lambda index: (abs(index - estimate.index), index))
    known = before[nearest].map_from_robot
    assert known is not None
    return found.poses[nearest].map_from_robot @ known.inverse() @ estimate.map_from_robot


def _scaled_camera(found: adjustment.Adjustment, before: Calibration, scale: float) -> Calibration:
    """Return the adjusted camera with its height scaled and its sigmas filled in."""
    calibration = with_range(before, found.calibration)
    height = scale * calibration.height_metres
    if not np.any(found.camera_covariance):
        return before
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    return replace(
        calibration,
        height_metres=height,
        max_range_metres=scale * calibration.max_range_metres,
        robot_from_image=compose_robot_from_image(
            calibration.camera_matrix,
            height,
            calibration.pitch_radians,
            calibration.roll_radians,
            calibration.ahead_radians,
        ),
        height_sigma_metres=scale * before.height_sigma_metres,
        focal_sigma_pixels=float(sigmas[0] * calibration.camera_matrix[0, 0]),
        pitch_sigma_radians=float(sigmas[3]),
        roll_sigma_radians=float(sigmas[4]),
        # That of the camera before; the frames say nothing of the height.
        covariance=None,
    )
