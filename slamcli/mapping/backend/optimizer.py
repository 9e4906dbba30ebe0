"""Batch optimisation of the pose graph, one connected component at a time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.pose_graph import GraphUpdate
from slamcli.mapping.backend.sensors import Sensors
from slamcli.stages import posegraph
from slamcli.stages.posegraph import SensorOffsets, SensorReadings

# Largest sigmas with which GPS connects a fragment to others: an error of them must stay small
# beside the fragment itself. [guarded by tests/mapping/backend/test_sensors.py]
_MAX_MERGED_HEADING_SIGMA_RADIANS = 0.1
_MAX_MERGED_ORIGIN_SIGMA_METRES = 1.0
# With a larger sigma the map's heading on Earth is unknown: no georeference.
# [guarded by tests/mapping/backend/test_sensors.py]
_MAX_HEADING_SIGMA_RADIANS = 1.0
# With more outliers than that, which of the readings are the wrong ones is not known: no
# georeference. [guarded by tests/mapping/backend/test_sensors.py]
_MAX_OUTLIER_SHARE = 0.5
# Kinds of links in the order in which initial poses are composed along them; loops, which alone
# may be false, come last.
_RANK_OF_KIND = {"step": 0, "odometry": 1}
# Links that do not place a frame by what it shows: odometry has a share in both.
_NOT_BY_PICTURE = ("odometry", "partial")
# Why a frame that was placed by its picture no longer is.
CONTRADICTED = "its links contradict one another, or one link alone is too uncertain"

InitialPoses = dict[int, Pose2]


@dataclass(frozen=True, slots=True, eq=False)
class OptimizedComponent:
    """Solution of one connected component.

    Attributes
    ----------
    solution : posegraph.Solution
    links : tuple of int
        Indices of the links that were used.
    switched_off : frozenset of int
        Those of them that the others contradict.
    georeference : Georeference or None
        None when GPS does not determine where on Earth the component lies.
    """

    solution: posegraph.Solution
    links: tuple[int, ...]
    switched_off: frozenset[int]
    georeference: Georeference | None


class BatchOptimizer:
    """Least-squares optimisation of estimates, links and readings as they are at one moment.

    Parameters
    ----------
    estimates : sequence of PoseEstimate
        One for every frame, sorted by index.
    links : sequence of Link
    sensors : Sensors
    left_out : collection of int
        Indices of links that are not used.
    """

    def __init__(
        self,
        estimates: Sequence[PoseEstimate],
        links: Sequence[Link],
        sensors: Sensors,
        left_out: Collection[int] = frozenset(),
    ) -> None:
        self._estimates = {estimate.index: estimate for estimate in estimates}
        self._links = links
        self._used = [n for n in range(len(links)) if n not in left_out]
        self._sensors = sensors

    def components(self) -> list[InitialPoses]:
        """Return the initial poses of each component that links and odometry connect.

        Frames before the first one that was placed are left out: the map begins there.
        """
        estimates = self._estimates
        chain = self._sensors.chain(list(estimates.values()))
        placed = {index for index, e in estimates.items() if e.map_from_robot is not None}
        known = placed.union(*((link.a, link.b) for link in chain))
        components = []
        links = [link for link in self._used_links() if {link.a, link.b} <= known]
        for group in posegraph.components(sorted(known), [*links, *chain]):
            first = next((index for index in group if index in placed), None)
            if first is not None:
                components.append(
                    self._initial_poses([index for index in group if index >= first], chain)
                )
        return components

    def optimize(
        self, initial: InitialPoses, fixed: Collection[int] = (), prior: SensorOffsets | None = None
    ) -> OptimizedComponent:
        """Solve one component.

        Parameters
        ----------
        initial : dict of frame index to Pose2
            ``map_from_robot``.
        fixed : collection of int
            Frames that stay where they are, in place of the first one; their readings were used by
            an earlier solution.
        prior : SensorOffsets or None
            The offsets by the readings of earlier solutions.
        """
        used = [
            n for n in self._used if self._links[n].a in initial and self._links[n].b in initial
        ]
        frames = [
            replace(self._estimates[index], map_from_robot=initial[index], fragment=0)
            for index in sorted(initial)
        ]
        free = [frame for frame in frames if frame.index not in fixed]
        positions = self._sensors.positions(free)
        lever_arm = self._sensors.options.lever_arm_metres
        solution = posegraph.solve(
            initial,
            [self._links[n] for n in used] + self._sensors.chain(frames),
            SensorReadings(
                self._sensors.headings(free),
                positions,
                lever_arm if prior is None else prior.lever_arm_metres,
                prior,
            ),
            fixed=fixed,
        )
        outliers = frozenset(used[k] for k in solution.switched_off if k < len(used))
        georeference = self._georeference(solution, len(positions))
        return OptimizedComponent(solution, tuple(used), outliers, georeference)

    def solve(self, initial: InitialPoses, fragment: int) -> GraphUpdate:
        """Solve one component, its first frame at the origin, as a numbered fragment."""
        optimized = self.optimize(initial)
        solution = optimized.solution
        scores = self._scores_by_picture(optimized)
        doubted = {
            end
            for n in set(range(len(self._links))) - (set(optimized.links) - optimized.switched_off)
            for end in (self._links[n].a, self._links[n].b)
        }
        estimates = []
        for index in sorted(initial):
            known = self._estimates[index]
            was_tracked = known.status == "tracked"
            tracked = index in scores or (was_tracked and index not in doubted)
            reason = known.reason
            if tracked != was_tracked:
                reason = "" if tracked else CONTRADICTED
            estimates.append(
                replace(
                    known,
                    map_from_robot=solution.poses[index],
                    covariance=solution.covariances[index],
                    fragment=fragment,
                    status="tracked" if tracked else "predicted",
                    reason=reason,
                    score=scores.get(index, known.score) if index in doubted else known.score,
                )
            )
        return GraphUpdate(
            fragment,
            tuple(estimates),
            optimized.links,
            optimized.switched_off,
            solution.offsets,
            optimized.georeference,
        )

    def _scores_by_picture(self, optimized: OptimizedComponent) -> dict[int, float]:
        """Return the highest score of the links that place each frame by what it shows."""
        scores: dict[int, float] = {}
        for n in set(optimized.links) - optimized.switched_off:
            link = self._links[n]
            if link.kind not in _NOT_BY_PICTURE:
                for end in (link.a, link.b):
                    scores[end] = max(scores.get(end, 0.0), link.score)
        return scores

    def _used_links(self) -> list[Link]:
        return [self._links[n] for n in self._used]

    def merge_by_gps(self, components: list[InitialPoses]) -> list[InitialPoses]:
        """Return the components, those merged into one whose georeferences are certain enough."""
        if len(components) < 2 or self._sensors.datum_degrees is None:
            return components
        merged: InitialPoses = {}
        apart = []
        for initial in components:
            optimized = self.optimize(initial)
            if optimized.georeference is not None and _is_certain(optimized.georeference):
                here = optimized.georeference.east_north_from_map
                merged.update((k, here @ pose) for k, pose in optimized.solution.poses.items())
            else:
                apart.append(initial)
        if not merged:
            return apart
        back = merged[min(merged)].inverse()
        return [{index: back @ merged[index] for index in sorted(merged)}, *apart]

    def _georeference(self, solution: posegraph.Solution, readings: int) -> Georeference | None:
        offsets, datum = solution.offsets, self._sensors.datum_degrees
        heading_sigma = float(np.sqrt(offsets.east_north_covariance[2, 2]))
        outliers = len(solution.position_outliers)
        if datum is None or not readings or heading_sigma > _MAX_HEADING_SIGMA_RADIANS:
            return None
        if outliers > _MAX_OUTLIER_SHARE * readings:
            self._sensors.gps_fault = (
                f"contradicts the frames in {outliers} of {readings} readings: are latitude and "
                "longitude exchanged, or do the clocks differ (--time-offset)?"
            )
            return None
        return Georeference(
            datum,
            offsets.east_north_from_map,
            offsets.east_north_covariance,
            offsets.lever_arm_metres,
            readings + self._sensors.no_fixes,
            outliers + self._sensors.no_fixes,
        )

    def _initial_poses(self, group: list[int], chain: list[Link]) -> InitialPoses:
        """Return poses composed from a component's first frame along a spanning tree of its links.

        Along steps where possible, else odometry, else loops.
        """
        members = set(group)
        links = [link for link in [*self._used_links(), *chain] if {link.a, link.b} <= members]
        links.sort(key=lambda link: _RANK_OF_KIND.get(link.kind, len(_RANK_OF_KIND)))
        neighbours: dict[int, list[tuple[int, Pose2]]] = {index: [] for index in group}
        for link in posegraph.spanning(group, links):
            neighbours[link.a].append((link.b, link.a_from_b))
            neighbours[link.b].append((link.a, link.a_from_b.inverse()))
        poses = {group[0]: Pose2()}
        queue = [group[0]]
        for index in queue:
            for other, pose in neighbours[index]:
                if other not in poses:
                    poses[other] = poses[index] @ pose
                    queue.append(other)
        return poses


def _is_certain(georeference: Georeference) -> bool:
    sigmas = np.sqrt(np.diag(georeference.covariance))
    heading, origin = float(sigmas[2]), float(sigmas[:2].max())
    return heading < _MAX_MERGED_HEADING_SIGMA_RADIANS and origin < _MAX_MERGED_ORIGIN_SIGMA_METRES
