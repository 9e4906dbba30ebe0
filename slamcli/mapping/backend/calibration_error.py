"""The calibration's errors in the poses' covariances: all links have them, and none shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.sensitivity import PARAMETERS, motion_sensitivities
from slamcli.core.geometry import pose_array
from slamcli.core.records import Link, PoseEstimate
from slamcli.mapping.backend.pose_graph import PoseGraph, placed_fragments
from slamcli.mapping.backend.sensors import Sensors
from slamcli.stages import posegraph
from slamcli.stages.posegraph import SensorReadings


def with_calibration_error(
    graph: PoseGraph, sensors: Sensors, calibration: Calibration
) -> list[PoseEstimate]:
    """Return a graph's estimates, the calibration's covariance carried over to theirs.

    As they are where it is not known.
    """
    estimates = {estimate.index: estimate for estimate in graph.estimates}
    if calibration.covariance is None or calibration.unit == "px":
        return list(estimates.values())
    kept = [link for n, link in enumerate(graph.links) if n not in graph.switched_off]
    for members in placed_fragments(graph.estimates).values():
        poses = {e.index: e.map_from_robot for e in members if e.map_from_robot is not None}
        links = [link for link in kept if link.a in poses and link.b in poses]
        chain = sensors.chain(members)
        readings = SensorReadings(
            sensors.headings(members),
            sensors.positions(members),
            sensors.options.lever_arm_metres,
        )
        by_link = np.concatenate(
            [_sensitivities(calibration, links), np.zeros((len(chain), 3, PARAMETERS))]
        )
        moved = posegraph.pose_sensitivities(poses, [*links, *chain], readings, by_link)
        for index, by_pose in moved.items():
            known = estimates[index]
            assert known.covariance is not None
            added = by_pose @ calibration.covariance @ by_pose.T
            estimates[index] = replace(known, covariance=known.covariance + added)
    return list(estimates.values())


def _sensitivities(calibration: Calibration, links: Sequence[Link]) -> np.ndarray:
    return motion_sensitivities(calibration, pose_array([link.a_from_b for link in links]))
