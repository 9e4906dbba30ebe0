"""All that is known weighed at once: what hangs together, and what solves it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.sensors import Senses
from slamcli.stages import posegraph
from slamcli.stages.posegraph import SenseOffsets

# A fragment so surely placed on Earth is tied to others that are.
_SURE_HEADING_RADIANS = 0.1
_SURE_PLACE_METRES = 1.0
# One less sure than this is not placed on Earth at all.
_LEAST_SURE_HEADING_RADIANS = 1.0
# What first poses are walked along, before any other kind.
_TRUST = {"step": 0, "odometry": 1}

Part = dict[int, Pose2]


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
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


class Weighing:
    """Estimates, links and readings, as they are at one moment.

    Parameters
    ----------
    estimates : sequence of PoseEstimate
        One for every frame, in order.
    links : sequence of Link
    senses : Senses
    """

    def __init__(
        self, estimates: Sequence[PoseEstimate], links: Sequence[Link], senses: Senses
    ) -> None:
        self._estimates = {estimate.index: estimate for estimate in estimates}
        self._links = links
        self._senses = senses

    def parts(self) -> list[Part]:
        """Return what links and odometry connect: first poses of its frames, from the first one on.

        Frames before the first that was placed are left out: the map begins there.
        """
        estimates = self._estimates
        chain = self._senses.chain(list(estimates.values()))
        placed = {index for index, e in estimates.items() if e.map_from_robot is not None}
        known = placed.union(*((link.a, link.b) for link in chain))
        parts = []
        for group in posegraph.components(sorted(known), [*self._links, *chain]):
            first = next((index for index in group if index in placed), None)
            if first is not None:
                parts.append(self._spread([index for index in group if index >= first], chain))
        return parts

    def weigh(
        self, initial: Part, held: Collection[int] = (), prior: SenseOffsets | None = None
    ) -> Weighed:
        """Solve one part, its first frame at the origin.

        Parameters
        ----------
        initial : dict
        held : collection of int
            Frames that stay where they are, in place of the first one; their readings have been
            weighed before.
        prior : SenseOffsets or None
            What these told.
        """
        numbers = [n for n, link in enumerate(self._links) if link.a in initial]
        frames = [
            replace(self._estimates[index], map_from_robot=initial[index], fragment=0)
            for index in sorted(initial)
        ]
        free = [frame for frame in frames if frame.index not in held]
        places = self._senses.places(free)
        lever_arm = self._senses.options.lever_arm_metres
        solution = posegraph.solve(
            initial,
            [self._links[n] for n in numbers] + self._senses.chain(frames),
            self._senses.headings(free),
            places,
            lever_arm_metres=lever_arm if prior is None else prior.lever_arm_metres,
            held=held,
            prior=prior,
        )
        off = frozenset(numbers[k] for k in solution.switched_off if k < len(numbers))
        georeference = self._georeference(solution, len(places))
        return Weighed(solution, tuple(numbers), off, georeference)

    def tied_by_gps(self, parts: list[Part]) -> list[Part]:
        """Return the parts, those that GPS places on Earth surely enough made one."""
        if len(parts) < 2 or self._senses.datum_degrees is None:
            return parts
        together: Part = {}
        apart = []
        for initial in parts:
            weighed = self.weigh(initial)
            if weighed.georeference is not None and _sure(weighed.georeference):
                here = weighed.georeference.east_north_from_map
                together.update((k, here @ pose) for k, pose in weighed.solution.poses.items())
            else:
                apart.append(initial)
        if not together:
            return apart
        back = together[min(together)].inverse()
        return [{index: back @ together[index] for index in sorted(together)}, *apart]

    def _georeference(self, solution: posegraph.Solution, readings: int) -> Georeference | None:
        offsets, datum = solution.offsets, self._senses.datum_degrees
        heading_sigma = float(np.sqrt(offsets.east_north_covariance[2, 2]))
        if datum is None or not readings or heading_sigma > _LEAST_SURE_HEADING_RADIANS:
            return None
        return Georeference(
            datum,
            offsets.east_north_from_map,
            offsets.east_north_covariance,
            offsets.lever_arm_metres,
            readings,
            len(solution.places_off),
        )

    def _spread(self, group: list[int], chain: list[Link]) -> Part:
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
