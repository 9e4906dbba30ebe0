"""The mapper: frames in, poses out. No file, thread, clock or print.

Tracking registers a frame to the latest keyframes. A frame without an accepted registration is
relocalised on the whole map, else lost, with the reason. Lost frames that fit one another begin a
fragment, a map of their own, until a link connects it to an older one. `finish` closes the
remaining loops and optimises the pose graph.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.core.failures import FAILURES, logged
from slamcli.core.geometry import Grid
from slamcli.core.records import FloorMap, Frame, Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import (
    CompassReading,
    Georeference,
    GpsReading,
    OdometryReading,
    TelemetryOptions,
)
from slamcli.mapping import camera_tilt
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.backend.calibration_error import with_calibration_error
from slamcli.mapping.backend.pose_graph import lost
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.frame_checks import is_known
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.mapping.locks import ReentrantLock
from slamcli.mapping.lookahead import compute_ahead
from slamcli.mapping.loop_closure import LoopCloser, Spread
from slamcli.mapping.lost_frames import LostFrames, PrepareAgain
from slamcli.mapping.motion_model import MotionModel
from slamcli.mapping.preprocessing import Preprocessor
from slamcli.mapping.relocalization import Relocalizer
from slamcli.mapping.revisiting import Revisiting
from slamcli.mapping.saved_state import MapperState
from slamcli.mapping.tracking import Tracker, is_mostly_confirmed
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult


class Mapper:
    """Locates a camera over a floor and maps the floor at the same time (SLAM).

    `update` never raises: what cannot be used is lost, with the reason. Threads may share a mapper:
    calls wait for one another, and frames are placed in the order in which they arrive.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    telemetry : TelemetryOptions
        How readings of odometry, compass and GPS are used.
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions | None = None,
        telemetry: TelemetryOptions | None = None,
    ) -> None:
        self.calibration = calibration
        self.options = options or MapperOptions()
        self._preprocessor = Preprocessor(calibration, self.options)
        self._backend = Backend(Sensors(telemetry), calibration.max_range_metres)
        self._graph = self._backend.graph
        self._database = KeyframeDatabase(self.grid, self.options.matching.seed)
        relocalizer = Relocalizer(calibration, self.options, self._database)
        self._loop_closer = LoopCloser(calibration, self.options, relocalizer)
        self._tracking = TrackingState()
        self._motion_model = MotionModel(
            calibration, self.options, self._tracking, self._graph, self.sensors
        )
        self._tracker = Tracker(calibration, self.options, self._tracking, self._motion_model)
        self._revisiting = Revisiting(
            calibration,
            self.options,
            self._tracking,
            self._motion_model,
            self._tracker,
            self._loop_closer,
            self._graph,
        )
        self._lost_frames = LostFrames(calibration, self.options, self._backend, self._database)
        self._registrations: list[RegistrationResult] = []
        self._lock = ReentrantLock()

    @property
    def grid(self) -> Grid:
        """Of the views that are compared by their pixels, in the robot frame."""
        return self._preprocessor.grid

    @property
    def metres_per_pixel(self) -> float:
        """Of the views that features are detected in, which are finer."""
        return self._preprocessor.metres_per_pixel

    @property
    def estimates(self) -> list[PoseEstimate]:
        """One for every frame so far, sorted by index, as revised by all that followed.

        Covariances include the calibration's errors.
        """
        with self._lock:
            return with_calibration_error(self._graph, self.sensors, self.calibration)

    @property
    def frame_count(self) -> int:
        """Number of frames so far, placed or not."""
        with self._lock:
            return len(self._graph.order)

    @property
    def links(self) -> list[Link]:
        """Every measured motion between two frames, in the order of insertion."""
        with self._lock:
            return list(self._graph.links)

    @property
    def registrations(self) -> list[RegistrationResult]:
        """The registrations of the latest step, in their order."""
        return list(self._registrations)

    @property
    def sensors(self) -> Sensors:
        """All readings so far."""
        return self._backend.sensors

    @property
    def sensor_faults(self) -> list[str]:
        """What is wrong with the readings, a line each; odometry that contradicts is not used."""
        with self._lock:
            return self.sensors.faults

    @property
    def georeferences(self) -> dict[int, Georeference]:
        """Where on Earth each fragment that GPS determines lies, as of the latest solution."""
        return dict(self._graph.georeferences)

    @property
    def switched_off(self) -> frozenset[int]:
        """Indices in `links` of those that the others contradict, as of the latest solution."""
        return self._graph.switched_off

    def odometry(self, reading: OdometryReading) -> None:
        """Add a reading: predicts frames that show nothing, and bounds the search for others.

        It covers frames up to its own moment and a little beyond: add it before the frame.
        """
        _check_type(reading, OdometryReading)
        with self._lock:
            self.sensors.odometry(reading)

    def compass(self, reading: CompassReading) -> None:
        """Add a reading; its offset from the map, which all readings share, is estimated."""
        _check_type(reading, CompassReading)
        with self._lock:
            self.sensors.compass(reading)

    def gps(self, reading: GpsReading) -> None:
        """Add a reading; `georeferences` then has where on Earth the map lies.

        Raises
        ------
        InputError
            When pyproj is not installed, or it is no reading of this kind.
        """
        _check_type(reading, GpsReading)
        with self._lock:
            self.sensors.gps(reading)

    def update(self, frame: Frame | UInt8Array) -> PoseEstimate:
        """Locate one more frame; a frame that cannot be used is lost, with the reason.

        Parameters
        ----------
        frame : Frame, or (H, W[, 3]) uint8 BGR or gray pixels of the next one
        """
        if isinstance(frame, Frame):
            return self.step(self._preprocessor.prepare(frame, lazily=True))
        with self._lock:
            index = self._graph.next_index
            following = Frame(index, f"frame {index}", None, frame)
            return self.step(self._preprocessor.prepare(following, lazily=True))

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Compute all that needs no other frame; may run ahead on any thread. Never raises."""
        return self._preprocessor.prepare(frame)

    def prepare_ahead(self, frame: Frame) -> PreparedFrame:
        """Return the same as `prepare`, with what `step` is likely to need computed already."""
        prepared = self._preprocessor.prepare(frame, lazily=True)
        keyframe = not self._tracking.is_revisiting and self._database.is_expected(frame.index)
        compute_ahead(prepared, keyframe=keyframe)
        return prepared

    def step(self, prepared: PreparedFrame) -> PoseEstimate:
        """Place one prepared frame; frames come in order, and an index that came before is refused.

        So is one out of bounds. The refusal is an estimate too, lost and not kept. Never raises.
        """
        with self._lock:
            self._registrations = []
            if not is_known(prepared):
                return lost(prepared, prepared.reason or "its index or stamp is out of bounds")
            if prepared.index in self._graph:
                return lost(prepared, f"frame index {prepared.index} came before; give a new one")
            try:
                return self._step(prepared)
            except FAILURES as error:
                reason = f"cannot be placed: {logged(error)}"
                known = self._graph.get(prepared.index)
                return self._graph.set_estimate(lost(prepared, reason)) if known is None else known

    def _step(self, prepared: PreparedFrame) -> PoseEstimate:
        """Place a frame of a new index."""
        before = self._tracking.latest
        if before is not None and _same_picture(before, prepared):
            self._tracking.latest = prepared
            return self._backend.add_duplicate(before, prepared)
        sparsely = self._tracker.track_sparsely(prepared)
        if sparsely is not None:
            self._tracking.latest, self._registrations = prepared, [sparsely]
            return self._insert(prepared, self._registrations)
        if self.options.loops and (revisit := self._revisiting.track(prepared)):
            self._tracking.latest, self._registrations = prepared, revisit
            return self._revisit(prepared, *revisit)
        if not prepared.levels:
            reason = prepared.reason or prepared.pyramids.value.reason
            return self._backend.add_lost(prepared, reason)
        self._tracking.latest = prepared
        if not self.options.dense:
            assert prepared.features is not None
            found, needed = len(prepared.features), self.options.matching.min_inliers
            if found < needed:
                reason = f"{found} features; at least {needed} are needed"
                return self._backend.add_lost(prepared, reason)
        self._registrations = self._tracker.track(prepared, before)
        if any(result.link is not None for result in self._registrations):
            return self._insert(prepared, self._registrations)
        if not self._tracking.keyframes:
            self._begin_fragment(prepared)
            return self._join_fragments(prepared)
        return self._relocalize_or_keep(prepared)

    def finish(
        self, spread: Spread = map, prepare_again: PrepareAgain | None = None
    ) -> list[PoseEstimate]:
        """Close the remaining loops, optimise the pose graph and return every final estimate.

        Fragments that links connect become one; they are numbered from the one with most frames
        down, and each has its first frame as its origin. A frame without a link to any other is
        lost.

        While frames come, only loops by appearance are closed, and windows of the graph optimised,
        so that a robot keeps up; here all loops that the poses predict are. A robot may call it
        whenever it has the time, and go on mapping.

        Parameters
        ----------
        spread : function
            Like `map`, such as that of a `ThreadPoolExecutor`: used for the keyframes' loop
            closures, with the same result.
        prepare_again : function or None
            Of indices to these frames, as `prepare` returns them: lost frames that the poses before
            and after them predict are registered once more. None: they stay lost.
        """
        with self._lock:
            self.sensors.check()
            self._optimize(spread)
            tilts = self._tracking.tilts_radians
            while prepare_again is not None and self._lost_frames.place(prepare_again, tilts):
                self._optimize(spread)
            self._tracking.forget_lost(self._graph.is_placed)
            return self.estimates

    def _optimize(self, spread: Spread) -> None:
        """Optimise the pose graph, and again while the poses predict further loops."""
        self._backend.solve()
        while self.options.loops:
            loops = self._loop_closer.find_loops(self._graph, spread)
            if not loops:
                break
            self._backend.solve(loops)

    def floor_map(self) -> FloorMap | None:
        """Return what `Locator` needs of the map so far; None while nothing is placed."""
        keyframes = [k for k in self._database.keyframes if self._graph.is_placed(k.index)]
        if not keyframes:
            return None
        return FloorMap(
            self.calibration,
            self.options.features,
            self.metres_per_pixel,
            self.options.tilt_sigma_degrees,
            tuple(keyframes),
            tuple(self._graph.estimates),
            (*self._graph.links, *self.sensors.chain(self._graph.estimates)),
        )

    def extend(self, floor_map: FloorMap) -> None:
        """Continue a finished map, before any frame has come.

        The frames that follow begin a fragment of their own, which joins the map as soon as one of
        them is relocalised; `finish` then optimises both drives together, and older poses may move.

        Raises
        ------
        InputError
            When the map's views are not this mapper's: other features, camera or resolution.
        """
        assert not self._graph.next_index
        theirs = floor_map.features, floor_map.metres_per_pixel, floor_map.tilt_sigma_degrees
        ours = self.options.features, self.metres_per_pixel, self.options.tilt_sigma_degrees
        if theirs != ours or not np.array_equal(
            floor_map.calibration.robot_from_image, self.calibration.robot_from_image
        ):
            raise InputError("a map is extended with its own camera, features and resolution alone")
        self._backend.add_map(floor_map.estimates, floor_map.links)
        for keyframe in floor_map.keyframes:
            self._loop_closer.add_known(keyframe)

    def state(self) -> MapperState:
        """Return what `restore` needs to go on from here, with the same results to the last bit."""
        graph, next_fragment, smoother = self._backend.state()
        loops, tracking = self._loop_closer.state(), self._tracking.frames()
        return MapperState(graph, next_fragment, smoother, loops, tracking)

    def restore(self, state: MapperState, prepared: Mapping[int, PreparedFrame]) -> None:
        """Take over the state of a mapper of the same camera, options and readings.

        Parameters
        ----------
        state : MapperState
        prepared : mapping
            The frames of ``state.tracking.indices``, prepared again.
        """
        self._backend.restore(state.graph, state.next_fragment, state.smoother)
        self._loop_closer.restore(state.loops)
        stored = {index: self._database.decode(index) for index in state.tracking.revisited}
        self._tracking.restore(state.tracking, {**prepared, **stored})

    def _insert(
        self,
        prepared: PreparedFrame,
        results: list[RegistrationResult],
        *,
        known: bool = False,
    ) -> PoseEstimate:
        """Insert a frame by its links into the pose graph; close the loops of a new keyframe.

        Parameters
        ----------
        prepared : PreparedFrame
        results : list of RegistrationResult
        known : bool
            Whether an earlier keyframe shows the frame's floor, so that it becomes none.
        """
        results = [
            camera_tilt.with_rocking(
                result, self._tracking.tilts_radians, self.calibration, self.options
            )
            for result in results
        ]
        accepted = [(result, result.link) for result in results if result.link is not None]
        links = [link for _, link in accepted]
        # Keyframe selection: the latest placed frame becomes one when tracking needed it.
        for result, link in accepted:
            if link.kind == "step" and result.keyframe not in self._tracking.keyframes:
                self._add_keyframe(result.keyframe)
            camera_tilt.add_link(result, self._tracking, self.options)
        revisited = links[0].kind == "step" and links[0].a in self._tracking.revisited
        estimate = self._backend.place(prepared, links, revisited=revisited)
        self._motion_model.update(prepared.index)
        last_lost, self._tracking.last_lost = self._tracking.last_lost, None
        self._tracking.last_placed = prepared
        if not known and self._tracker.is_keyframe(results):
            self._add_keyframe(prepared)
            estimate = self._join_fragments(prepared)
            if links[0].kind != "loop":
                estimate = self._close_loop(prepared)
        if last_lost is not None and not self._graph.is_placed(last_lost.index):
            return self._retry_last_lost(prepared, last_lost)
        return estimate

    def _revisit(
        self, prepared: PreparedFrame, step: RegistrationResult, loop: RegistrationResult
    ) -> PoseEstimate:
        """Insert a frame of floor that is known; those that follow are tracked by what shows it."""
        assert loop.link is not None
        self._insert(prepared, [step], known=True)
        self._backend.add_links(prepared.index, [loop.link])
        self._tracking.add_keyframe(loop.keyframe, self.options.recent_keyframes, revisited=True)
        return self._graph[prepared.index]

    def _relocalize_or_keep(self, prepared: PreparedFrame) -> PoseEstimate:
        """Place a frame by relocalisation, else by the lost one before it, else keep it as lost."""
        tracked = self._registrations
        last_lost = self._tracking.last_lost
        if self.options.loops:
            found = self._loop_closer.relocalize(
                prepared, self._graph, after_break=last_lost is not None
            )
            if found.registration is not None:
                self._registrations = [*tracked, found.registration]
                return self._insert(prepared, [found.registration])
        if last_lost is not None:
            window = self._motion_model.window_after_lost(last_lost, prepared)
            result = self._tracker.register(last_lost, prepared, window=window)
            self._registrations = [*tracked, result]
            if result.link is not None and is_mostly_confirmed(result):
                self._tracking.last_lost = None
                self._begin_fragment(last_lost)
                self._insert(prepared, [result])
                return self._backend.add_revised(prepared.index, (last_lost.index,))
        reason = _most_informative(tracked).reason
        partial = next((r.partial for r in tracked if r.partial is not None), None)
        if partial is None or self._motion_model.by_odometry(partial.a, prepared) is None:
            self._tracking.last_lost = prepared
            return self._backend.add_lost(prepared, reason)
        # Odometry determines the remaining direction; the next frame may show as much of this one.
        self._tracking.last_lost, self._tracking.last_placed = None, prepared
        return self._backend.add_lost(prepared, reason, partial)

    def _retry_last_lost(self, prepared: PreparedFrame, last_lost: PreparedFrame) -> PoseEstimate:
        """Register the lost frame to the one after it, which shows more of the same floor."""
        window = self._motion_model.window_back(prepared, last_lost)
        result = self._tracker.register(prepared, last_lost, window=window)
        self._registrations.append(result)
        if result.link is None:
            return self._graph[prepared.index]
        self._backend.place(last_lost, [result.link])
        return self._backend.add_revised(prepared.index, (last_lost.index,))

    def _join_fragments(self, keyframe: PreparedFrame) -> PoseEstimate:
        """Link a new keyframe to another fragment, if it is relocalised there."""
        if self.options.loops:
            found = self._loop_closer.join_fragments(keyframe, self._graph)
            if found.registration is not None and found.link is not None:
                self._registrations.append(found.registration)
                self._backend.add_links(keyframe.index, [found.link])
        return self._graph[keyframe.index]

    def _close_loop(self, keyframe: PreparedFrame) -> PoseEstimate:
        """Loop closure of a new keyframe with floor of its own fragment that was seen before."""
        if self.options.loops:
            link = self._loop_closer.close_on_arrival(keyframe, self._graph)
            if link is not None:
                self._backend.add_links(keyframe.index, [link])
        return self._graph[keyframe.index]

    def _begin_fragment(self, prepared: PreparedFrame) -> PoseEstimate:
        self._tracking.last_placed = prepared
        self._add_keyframe(prepared)
        return self._backend.begin_fragment(prepared)

    def _add_keyframe(self, prepared: PreparedFrame) -> None:
        self._tracking.add_keyframe(prepared, self.options.recent_keyframes)
        self._loop_closer.add(prepared)


def _check_type(reading: object, kind: type) -> None:
    if not isinstance(reading, kind):
        raise InputError(f"a reading of the type {type(reading).__name__}, not {kind.__name__}")


def _most_informative(results: list[RegistrationResult]) -> RegistrationResult:
    """Return the most informative failed registration: a pixel search if there was one."""
    return next((result for result in results if result.search is not None), results[0])


def _same_picture(a: PreparedFrame, b: PreparedFrame) -> bool:
    sparse = [one.sparse.value for one in (a, b)]
    painted = [one.second.image for one in sparse if one is not None]
    if len(painted) == 2 and not np.array_equal(painted[0], painted[1]):
        return False
    # A hundredth of the pixels differ where most do.
    if not (b.levels and a.levels and np.array_equal(a.levels[-1].image, b.levels[-1].image)):
        return False
    finest_a, finest_b = a.levels[0], b.levels[0]
    return np.array_equal(finest_a.image, finest_b.image) and np.array_equal(
        finest_a.mask, finest_b.mask
    )
