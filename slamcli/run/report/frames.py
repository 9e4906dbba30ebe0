"""What the page shows of maps, frames and links, as lists of numbers and texts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import covariance_in_map, pose_array, relative_poses
from slamcli.core.records import Link, PoseEstimate
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.report.pictures import data_url
from slamcli.run.report.run import FinishedRun

_QUALITY = 80
# The pictures of all maps together, as text: those of later, smaller maps are left out beyond.
_MAX_MAP_CHARACTERS = 4_000_000
_DIGITS = 6
# Beyond this many only those are listed that the others contradict, and the loops.
_MAX_LINKS = 20_000
# A corner of the camera's footprint is left out when the outline moves by less than this share.
_OUTLINE_SHARE = 0.01


def map_list(run: FinishedRun) -> list[dict[str, object]]:
    """Return each map's fragment, frames, picture and the grid that it lies on."""
    maps, spent = [], 0
    footprint = _footprint(run)
    fragments = placed_fragments(run.estimates)
    for number, (fragment, members) in enumerate(fragments.items()):
        one: dict[str, object] = {"fragment": fragment, "frames": len(members)}
        overview = run.painted.overviews[number] if number < len(run.painted.overviews) else None
        if overview is not None:
            url, grid = data_url(overview.image, _QUALITY), overview.grid
            spent += len(url)
            one |= {
                "picture": url if spent <= _MAX_MAP_CHARACTERS or number == 0 else "",
                "turn": overview.turn_radians,
                "x": grid.x_min,
                "y": grid.y_max,
                "scale": grid.metres_per_pixel,
                "width": grid.width,
                "height": grid.height,
            }
        maps.append({**one, "footprint": footprint})
    return maps


def _footprint(run: FinishedRun) -> list[list[float | None]]:
    """Return the outline of the floor that the camera sees, in the robot's axes."""
    try:
        hull = footprint_hull(run.calibration)
    except CalibrationError:
        return []
    length = np.linalg.norm(np.diff(hull, axis=0, append=hull[:1]), axis=1)
    along = np.cumsum(length) / length.sum()
    _, chosen = np.unique(np.floor(along / _OUTLINE_SHARE), return_index=True)
    return [_rounded(corner) for corner in hull[chosen]]


def frame_table(run: FinishedRun) -> list[list[object]]:
    """Return a row a frame.

    Name, stamp, status, reason, fragment, x, y, heading, their sigmas, inliers, score, and the
    pitch, roll and height of its rocking; lengths in the map's unit, angles in radians.
    """
    return [_frame_row(estimate) for estimate in run.estimates]


def _frame_row(estimate: PoseEstimate) -> list[object]:
    pose, covariance, rocking = estimate.map_from_robot, estimate.covariance, estimate.rocking
    head: list[object] = [estimate.name, _number(estimate.stamp), estimate.status, estimate.reason]
    if pose is None:
        return head
    sigmas: list[float | None] = [None] * 3
    if covariance is not None:
        sigmas = _rounded(np.sqrt(np.diag(covariance_in_map(pose, covariance))), 9)
    sway: list[float | None] = []
    if rocking is not None:
        sway = _rounded([rocking.pitch_radians, rocking.roll_radians, rocking.height_metres])
    place = _rounded([pose.x, pose.y, pose.theta])
    return [
        *(*head, estimate.fragment, *place, *sigmas),
        *(estimate.inliers, _number(estimate.score), *sway),
    ]


def link_table(run: FinishedRun) -> list[list[object]]:
    """Return a row a link between two placed frames of one map.

    Indices of its frames, kind, 1 when it is switched off, inliers, score, and how far the final
    poses are from it: length, angle (radians), and both in its sigmas.
    """
    registered = run.registered
    by_index = {estimate.index: estimate for estimate in run.estimates}
    kept = [
        (number, link)
        for number, link in enumerate(registered.links)
        if by_index[link.a].fragment == by_index[link.b].fragment >= 0
    ]
    if len(kept) > _MAX_LINKS:
        off = registered.switched_off
        kept = [(n, link) for n, link in kept if link.kind != "step" or n in off][:_MAX_LINKS]
    residuals = link_residuals([link for _, link in kept], run.estimates)
    if run.survey is not None:
        # A survey adjusts the matches themselves; the spread of its links is no measured one.
        residuals[:, 2] = math.nan
    return [
        [
            *(link.a, link.b, link.kind, int(number in registered.switched_off), link.inliers),
            *(_number(link.score), *_rounded(residual, 7)),
        ]
        for (number, link), residual in zip(kept, residuals, strict=True)
    ]


def link_residuals(links: Sequence[Link], estimates: Sequence[PoseEstimate]) -> Float64Array:
    """Return (N, 3): how far the poses are from each link: length, angle, and sigmas."""
    if not links:
        return np.zeros((0, 3))
    poses = {e.index: e.map_from_robot for e in estimates if e.map_from_robot is not None}
    first = pose_array([poses[link.a] for link in links])
    second = pose_array([poses[link.b] for link in links])
    measured = pose_array([link.a_from_b for link in links])
    error = relative_poses(measured, relative_poses(first, second))
    covariances = np.array([link.covariance for link in links])
    information = np.linalg.pinv(covariances, hermitian=True)
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    lengths = np.hypot(error[:, 0], error[:, 1])
    return np.column_stack([lengths, np.abs(error[:, 2]), np.sqrt(np.maximum(squared, 0.0))])


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), _DIGITS)


def _rounded(values: Sequence[float] | Float64Array, digits: int = _DIGITS) -> list[float | None]:
    numbers = np.asarray(values, np.float64).tolist()
    return [round(value, digits) if math.isfinite(value) else None for value in numbers]
