"""All that is known weighed at once: what hangs together, and what solves it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.sensors import Sensors
from slamcli.stages import posegraph
from slamcli.stages.posegraph import SensorOffsets

# A fragment so surely placed on Earth is tied to others that are.
_SURE_HEADING_RADIANS = 0.1
_SURE_PLACE_METRES = 1.0
# One less sure than this is not placed on Earth at all.
_MIN_SURE_HEADING_RADIANS = 1.0
# What first poses are walked along, before any other kind.
_TRUST = {"step": 0, "odometry": 1}

Component = dict[int, Pose2]


@dataclass(frozen=True, slots=True, eq=False)
class OptimizedComponent:
    """The solution of one part.

    Attributes
    ----------
    solution : posegraph.Solution
    numbers : tuple of int
        Which of all links it used.
    switched_off : frozenset of int
        Which of those the others contradict.
    georeference : Georeference or None
        None when GPS does not tell where on Earth the part lies.
    """

    solution: posegraph.Solution
    numbers: tuple[int, ...]
    switched_off: frozenset[int]
    georeference: Georeference | None


class BatchOptimizer:
    """Estimates, links and readings, as they are at one moment.

    Parameters
    ----------
    estimates : sequence of PoseEstimate
        One for every frame, in order.
    links : sequence of Link
    senses : Sensors
    """

    def __init__(
        self, estimates: Sequence[PoseEstimate], links: Sequence[Link], sensors: Sensors
    ) -> None:
        self._estimates = {estimate.index: estimate for estimate in estimates}
        self._links = links
        self._sensors = sensors

    def components(self) -> list[Component]:
        """Return what links and odometry connect: first poses of its frames, from the first one on.

        Frames before the first that was placed are left out: the map begins there.
        """
        estimates = self._estimates
        chain = self._sensors.chain(list(estimates.values()))
        placed = {index for index, e in estimates.items() if e.map_from_robot is not None}
        known = placed.union(*((link.a, link.b) for link in chain))
        components = []
        for group in posegraph.components(sorted(known), [*self._links, *chain]):
            first = next((index for index in group if index in placed), None)
            if first is not None:
                components.append(
                    self._initial_poses([index for index in group if index >= first], chain)
                )
        return components

    def optimize(
        self, initial: Component, held: Collection[int] = (), prior: SensorOffsets | None = None
    ) -> OptimizedComponent:
        """Solve one part, its first frame at the origin.

        Parameters
        ----------
        initial : dict
        held : collection of int
            Frames that stay where they are, in place of the first one; their readings have been
            weighed before.
        prior : SensorOffsets or None
            What these told.
        """
        numbers = [n for n, link in enumerate(self._links) if link.a in initial]
        frames = [
            replace(self._estimates[index], map_from_robot=initial[index], fragment=0)
            for index in sorted(initial)
        ]
        free = [frame for frame in frames if frame.index not in held]
        places = self._sensors.places(free)
        lever_arm = self._sensors.options.lever_arm_metres
        solution = posegraph.solve(
            initial,
            [self._links[n] for n in numbers] + self._sensors.chain(frames),
            self._sensors.headings(free),
            places,
            lever_arm_metres=lever_arm if prior is None else prior.lever_arm_metres,
            held=held,
            prior=prior,
        )
        off = frozenset(numbers[k] for k in solution.switched_off if k < len(numbers))
        georeference = self._georeference(solution, len(places))
        return OptimizedComponent(solution, tuple(numbers), off, georeference)

    def merge_by_gps(self, components: list[Component]) -> list[Component]:
        """Return the parts, those that GPS places on Earth surely enough made one."""
        if len(components) < 2 or self._sensors.datum_degrees is None:
            return components
        together: Component = {}
        apart = []
        for initial in components:
            optimized = self.optimize(initial)
            if optimized.georeference is not None and _sure(optimized.georeference):
                here = optimized.georeference.east_north_from_map
                together.update((k, here @ pose) for k, pose in optimized.solution.poses.items())
            else:
                apart.append(initial)
        if not together:
            return apart
        back = together[min(together)].inverse()
        return [{index: back @ together[index] for index in sorted(together)}, *apart]

    def _georeference(self, solution: posegraph.Solution, readings: int) -> Georeference | None:
        offsets, datum = solution.offsets, self._sensors.datum_degrees
        heading_sigma = float(np.sqrt(offsets.east_north_covariance[2, 2]))
        if datum is None or not readings or heading_sigma > _MIN_SURE_HEADING_RADIANS:
            return None
        return Georeference(
            datum,
            offsets.east_north_from_map,
            offsets.east_north_covariance,
            offsets.lever_arm_metres,
            readings,
            len(solution.places_off),
        )

    def _initial_poses(self, group: list[int], chain: list[Link]) -> Component:
        """Return first poses for a group, walked from its first frame.

        Along steps where they lead, else odometry, else loops: these alone may be false.
        """
        members = set(group)
        links = [link for link in [*self._links, *chain] if {link.a, link.b} <= members]
        links.sort(key=lambda link: _TRUST.get(link.kind, len(_TRUST)))
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


def _sure(georeference: Georeference) -> bool:
    sigmas = np.sqrt(np.diag(georeference.covariance))
    return bool(sigmas[2] < _SURE_HEADING_RADIANS and sigmas[:2].max() < _SURE_PLACE_METRES)
