"""What a mapper needs, beside its options and readings, to go on as if it had never stopped."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.geometry import Pose2
from slamcli.core.records import Keyframe, Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.stages.place_index import PlaceCandidate
from slamcli.stages.posegraph import SensorOffsets


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """A pose graph; the attributes are those of `PoseGraph`, the estimates in their order."""

    estimates: tuple[PoseEstimate, ...]
    links_before: list[int]
    links: list[Link]
    switched_off: tuple[int, ...]
    georeferences: dict[int, Georeference]
    offsets: dict[int, SensorOffsets]


@dataclass(frozen=True, slots=True)
class SmootherState:
    """When the graph was optimised: numbers of frames, and the earliest frame that loops reach."""

    solved_at: int = 0
    all_solved_at: int = 0
    closed_at: int = 0
    reaches_to: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LoopState:
    """The keyframes in the order of insertion, and what loop closure knows of them by index.

    Attributes
    ----------
    keyframes : list of Keyframe
    alike : dict of int to list of PlaceCandidate
        Those before each that look like it.
    linked : dict of int to list of int
    counted_links : int
        Links of the graph that `linked` has.
    path_lengths_metres : dict of int to float
    known, searched : tuple of int
    failed : dict of (int, int) to Pose2
        The guesses about which pairs did not fit.
    """

    keyframes: list[Keyframe]
    alike: dict[int, list[PlaceCandidate]]
    linked: dict[int, list[int]]
    counted_links: int
    path_lengths_metres: dict[int, float]
    known: tuple[int, ...]
    searched: tuple[int, ...]
    failed: dict[tuple[int, int], Pose2]


@dataclass(frozen=True, slots=True)
class TrackingFrames:
    """The frames that tracking still needs, by index.

    They are prepared again from their files, but for the keyframes that were revisited.
    """

    keyframes: tuple[int, ...]
    latest: int | None
    last_placed: int | None
    last_lost: int | None
    motion: Pose2 | None
    motion_frame: int
    prediction_errors: list[tuple[float, float]]
    revisited: tuple[int, ...]
    tilts_radians: list[float]

    @property
    def indices(self) -> set[int]:
        """Those that are prepared again."""
        others = (self.latest, self.last_placed, self.last_lost)
        keyframes = set(self.keyframes) - set(self.revisited)
        return keyframes | {index for index in others if index is not None}


@dataclass(frozen=True, slots=True, eq=False)
class MapperState:
    """The state of a mapper between two frames.

    Attributes
    ----------
    graph : GraphState
    next_fragment : int
    smoother : SmootherState
    loops : LoopState
    tracking : TrackingFrames
    """

    graph: GraphState
    next_fragment: int
    smoother: SmootherState
    loops: LoopState
    tracking: TrackingFrames


def check(state: MapperState) -> None:
    """Raise ValueError when a state refers to frames that it does not have."""
    located = {estimate.index for estimate in state.graph.estimates}
    keyframes = {keyframe.index for keyframe in state.loops.keyframes}
    ends = {end for link in state.graph.links for end in (link.a, link.b)}
    counted = not located or 0 <= min(located) <= max(located) == len(located) - 1
    if not (
        counted
        and ends | keyframes | state.tracking.indices <= located
        and set(state.tracking.revisited) <= keyframes & set(state.tracking.keyframes)
        and {*state.loops.alike, *state.loops.path_lengths_metres} <= keyframes
    ):
        raise ValueError("it refers to frames that it lacks")
