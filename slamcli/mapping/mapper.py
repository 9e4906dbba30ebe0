"""The loop: frames in, poses out. No file, thread, clock or print.

A frame is compared with the latest keyframes. A fit is believed when its features agree
(`stages.align`) and its pixels do, or when the pixels alone single it out (`stages.dense`); a
frame without a believed fit is lost, with the reason. Lost frames that fit one another start a
fragment, a map of their own, until a link ties it to an older one. `finish` weighs all links
against one another.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError, InputError
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import FloorMap, Frame, Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import (
    CompassReading,
    Georeference,
    GpsReading,
    OdometryReading,
    TelemetryOptions,
)
from slamcli.mapping.backend.backend import Backend, lost
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.loop_closure import LoopCloser, Spread
from slamcli.registration import RegistrationResult, register
from slamcli.registration.preparation import assemble
from slamcli.stages import dense, features, view

# Frames so near in time may be searched for anywhere in each other.
_MAX_UNGUIDED_STEPS = 2
_SEARCHED_SIGMAS = 3.0
# A second keyframe tells whether the first fit was right, however little it shares. A third that
# shares less than this makes a steady camera's pose no better known, and a rocking one's worse.
_MIN_OVERLAP_OF_THIRD = 0.4


class Mapper:
    """Locates a camera over a floor that it maps as it goes.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    telemetry : TelemetryOptions
        How readings of the robot's other senses are taken.
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions | None = None,
        telemetry: TelemetryOptions | None = None,
    ) -> None:
        self.calibration = calibration
        self.options = options or MapperOptions()
        self.metres_per_pixel = self.options.metres_per_pixel or view.registration_metres_per_pixel(
            calibration
        )
        self._tilt = math.radians(self.options.tilt_sigma_degrees)
        self._resamplers = [view.make_view_resampler(calibration, self.metres_per_pixel)]
        if self.options.dense:
            far = view.make_far_resampler(calibration, self.metres_per_pixel)
            self._resamplers += [] if far is None else [far]
        self._stencils = [dense.make_level_masks(resampler.mask) for resampler in self._resamplers]
        self._graph = Backend(Sensors(telemetry))
        self._loops = LoopCloser(calibration, self.options, self.grid)
        self._keyframes: list[PreparedFrame] = []
        self._latest: PreparedFrame | None = None
        self._motion: Pose2 | None = None
        self._motion_frame = 0
        self._last_lost: PreparedFrame | None = None
        self._last_placed: PreparedFrame | None = None
        self._trials: list[RegistrationResult] = []

    @property
    def grid(self) -> Grid:
        """Of the views that are matched, in the robot frame."""
        return self._resamplers[0].grid

    @property
    def estimates(self) -> list[PoseEstimate]:
        """One for every frame so far, in order, as revised by all that followed."""
        return self._graph.estimates

    @property
    def links(self) -> list[Link]:
        """Every measured motion between two frames, in the order of their making."""
        return list(self._graph.links)

    @property
    def trials(self) -> list[RegistrationResult]:
        """The comparisons that the latest step made, in their order."""
        return list(self._trials)

    def update(self, frame: Frame | UInt8Array) -> PoseEstimate:
        """Locate one more frame; a frame that cannot be used is lost, with the reason.

        Parameters
        ----------
        frame : Frame, or (H, W[, 3]) uint8 BGR or gray pixels of the next one
        """
        if not isinstance(frame, Frame):
            index = self._graph.next_index
            frame = Frame(index, f"frame {index}", None, frame)
        return self.step(self.prepare(frame))

    def odometry(self, reading: OdometryReading) -> None:
        """Take a reading; frames that show nothing are predicted by it, and others searched for.

        It tells of frames up to its own moment and a little beyond: give it before the frame.
        """
        self._graph.sensors.odometry(reading)

    def compass(self, reading: CompassReading) -> None:
        """Take a reading; its offset from the map, which all readings share, is estimated."""
        self._graph.sensors.compass(reading)

    def gps(self, reading: GpsReading) -> None:
        """Take a reading; `georeferences` then tells where on Earth the map lies.

        Raises
        ------
        InputError
            When pyproj is not installed.
        """
        self._graph.sensors.gps(reading)

    @property
    def sensors(self) -> Sensors:
        """All readings so far."""
        return self._graph.sensors

    @property
    def georeferences(self) -> dict[int, Georeference]:
        """Where on Earth each fragment that GPS tells of lies, as of the latest solution."""
        return dict(self._graph.georeferences)

    @property
    def switched_off(self) -> frozenset[int]:
        """Places in `links` of those that the others contradict, as of the latest solution."""
        return self._graph.switched_off

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Compute all that needs no other frame; may run ahead on any thread. Never raises."""
        try:
            view.check_frame(frame, self.calibration)
            views = view.make_compared_views(frame, self._resamplers)
            seen = views[0]
            view.check_view(seen)
            found = features.extract(seen, self.calibration, self.options.features, self._tilt)
            # A mask of the frame's own makes its views' masks others than the camera's.
            return assemble(frame, views, found, self._stencils if frame.mask is None else None)
        except FrameError as error:
            reason = str(error)
        except (cv2.error, ValueError, TypeError) as error:
            reason = f"cannot be processed: {' '.join(str(error).split())}"
        return PreparedFrame(frame.index, frame.name, frame.stamp, None, None, reason)

    def step(self, prepared: PreparedFrame) -> PoseEstimate:
        """Place one prepared frame; frames come in order, and an index that came before is refused.

        The refusal is an estimate too, lost and not kept.
        """
        self._trials = []
        if prepared.index in self._graph:
            return lost(prepared, f"frame index {prepared.index} came before; give a new one")
        if prepared.view is None or prepared.features is None:
            return self._graph.add_lost(prepared, prepared.reason)
        before, self._latest = self._latest, prepared
        if before is not None and _same_picture(before, prepared):
            return self._graph.add_duplicate(before, prepared)
        found, needed = len(prepared.features), self.options.matching.min_inliers
        if found < needed and not self.options.dense:
            return self._graph.add_lost(prepared, f"{found} features; at least {needed} are needed")
        trials = self._trials = self._compare(prepared, before)
        if any(trial.link is not None for trial in trials):
            return self._insert(prepared, trials)
        if not self._keyframes:
            self._begin_fragment(prepared)
            return self._join_fragments(prepared)
        return self._relocalize_or_keep(prepared, trials)

    def finish(self, spread: Spread = map) -> list[PoseEstimate]:
        """Weigh all links against one another and return every frame's final estimate.

        Fragments that links connect become one; they are numbered from the one with most frames
        down, and each has its first frame as its origin. A frame that nothing ties to any other
        is lost.

        LoopCloser are closed as frames come where these look like floor seen before, and what lies
        between is solved so seldom that a robot keeps up; here all that the poses tell of are. A
        robot may ask for it whenever it has the time, and go on mapping.

        Parameters
        ----------
        spread : function
            Like `map`, such as that of a `ThreadPoolExecutor`: keyframes look for their loops by
            it, with the same result.
        """
        self._graph.solve()
        while self.options.loops and (found := self._loops.find_loops(self._graph, spread)):
            self._graph.links += found
            self._graph.solve()
        return self.estimates

    def _relocalize_or_keep(
        self, prepared: PreparedFrame, trials: list[RegistrationResult]
    ) -> PoseEstimate:
        """Look for a frame that fits no recent one on the whole map, then beside a stray."""
        if self.options.loops:
            astray = self._last_lost is not None
            relocalized = self._loops.relocalize(prepared, self._graph, after_break=astray).trial
            if relocalized is not None:
                self._trials = [*trials, relocalized]
                return self._insert(prepared, [relocalized])
        if self._last_lost is not None:
            trial = self._register(
                self._last_lost, prepared, window=self._window_after_lost(prepared)
            )
            self._trials = [*trials, trial]
            if trial.link is not None:
                stray, self._last_lost = self._last_lost, None
                self._begin_fragment(stray)
                self._insert(prepared, [trial])
                return self._graph.revise(prepared.index, (stray.index,))
        reason = _most_informative(trials).reason
        partial = next((t.partial for t in trials if t.partial is not None), None)
        if partial is not None and self._graph.odometry_between(partial.a, prepared) is not None:
            # Odometry tells the rest; the next frame may show as much of this one.
            self._last_lost, self._last_placed = None, prepared
            return self._graph.add_lost(prepared, reason, partial)
        self._last_lost = prepared
        return self._graph.add_lost(prepared, reason)

    def floor_map(self) -> FloorMap | None:
        """Return what it takes to find oneself in the map so far; None while nothing is placed."""
        kept = [k for k in self._loops.keyframes if self._graph.is_placed(k.index)]
        if not kept:
            return None
        return FloorMap(
            self.calibration,
            self.options.features,
            self.metres_per_pixel,
            self.options.tilt_sigma_degrees,
            tuple(kept),
            tuple(self._graph.estimates),
            (*self._graph.links, *self._graph.sensors.chain(self._graph.estimates)),
        )

    def extend(self, floor_map: FloorMap) -> None:
        """Go on where a finished map ends, before any frame has come.

        The frames that follow begin a fragment of their own, which joins the map as soon as one of
        them is recognised; `finish` then weighs both drives together, and older poses may move.

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
            raise InputError("a map is gone on with by its own camera, features and resolution")
        for estimate in floor_map.estimates:
            self._graph.adopt(estimate)
        self._graph.links += floor_map.links
        for keyframe in floor_map.keyframes:
            self._loops.add_known(keyframe)

    def _compare(
        self, prepared: PreparedFrame, before: PreparedFrame | None
    ) -> list[RegistrationResult]:
        """Try the latest keyframes, newest first: those that tell more once one has been believed.

        When none is, the frame before is tried, on its pixels too, and at last near to where the
        robot's latest motion would have brought it: there descriptors compete with fewer others.
        """
        trials: list[RegistrationResult] = []
        for keyframe in reversed(self._keyframes):
            believed = [trial for trial in trials if trial.link is not None]
            guess = None
            if believed:
                if believed[0].overlap >= self.options.keyframe_overlap:
                    break
                guess = self._predict_from_link(believed[0], keyframe)
                least = self.options.min_overlap if len(believed) < 2 else _MIN_OVERLAP_OF_THIRD
                if guess is None or self._overlap(keyframe, prepared, guess) < least:
                    continue
            expected = self._predict_from_motion(keyframe, prepared)
            trials.append(self._register(keyframe, prepared, guess, expected=expected))
        if any(trial.link is not None for trial in trials):
            return trials
        return trials + self._register_by_pixels(prepared, before)

    def _overlap(self, keyframe: PreparedFrame, prepared: PreparedFrame, guess: Pose2) -> float:
        assert keyframe.view is not None
        assert prepared.view is not None
        return dense.overlap(keyframe.view, prepared.view, guess)

    def _register_by_pixels(
        self, prepared: PreparedFrame, before: PreparedFrame | None
    ) -> list[RegistrationResult]:
        """Search the pixels of the latest placed frame; then try a guess; stop when one fits."""
        if not self._keyframes:
            return []
        recent = self._last_placed or self._keyframes[-1]
        attempts: list[tuple[Pose2 | None, dense.SearchWindow | None]] = []
        window = self._window(recent, prepared)
        if (self.options.dense and window is not None) or recent is not self._keyframes[-1]:
            attempts.append((None, window))
        if self._motion is not None and recent is before:
            attempts.append((self._motion, None))
        trials = []
        for guess, window in attempts:
            trials.append(self._register(recent, prepared, guess, window=window))
            if trials[-1].link is not None:
                if recent is not self._keyframes[-1]:
                    self._add_keyframe(recent)
                break
        return trials

    def _window(
        self, keyframe: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return where a frame may lie for a placed one: near where it was heading, if it is known.

        A floor that repeats shows the same again a little further on, where no robot can have come
        to in so short a time. After a time long enough the pixels alone are no proof: None.
        """
        if (window := self._window_from_odometry(keyframe, prepared)) is not None:
            return window
        if self._motion is None:
            return self._window_everywhere(keyframe, prepared)
        steps = prepared.index - self._motion_frame
        return self._window_from_motion(self._motion_from(keyframe), steps)

    def _window_after_lost(self, prepared: PreparedFrame) -> dense.SearchWindow | None:
        """Return where a frame may lie for the latest lost one: as far on as frames did before."""
        assert self._last_lost is not None
        if (window := self._window_from_odometry(self._last_lost, prepared)) is not None:
            return window
        if self._motion is None:
            return self._window_everywhere(self._last_lost, prepared)
        return self._window_from_motion(Pose2(), prepared.index - self._last_lost.index)

    def _window_from_odometry(
        self, other: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return where odometry says that a frame lies for another, as free as after one step."""
        carried = self._graph.odometry_between(other.index, prepared)
        if carried is None:
            return None
        motion, covariance = carried
        share = self.options.search_share_of_range * self.calibration.max_range_metres
        radius = share + _SEARCHED_SIGMAS * math.sqrt(covariance[:2, :2].max())
        if radius > 2.0 * self.calibration.max_range_metres:
            return None
        return dense.SearchWindow(motion, math.radians(self.options.search_angle_degrees), radius)

    def _window_everywhere(
        self, other: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return everywhere for frames that follow each other; nowhere for others."""
        if prepared.index - other.index > _MAX_UNGUIDED_STEPS:
            return None
        return dense.SearchWindow(angle_radians=math.radians(self.options.search_angle_degrees))

    def _window_from_motion(self, start: Pose2, steps: int) -> dense.SearchWindow | None:
        """Return where so many steps like the latest motion lead to, each as free as one is."""
        assert self._motion is not None
        share = self.options.search_share_of_range * self.calibration.max_range_metres
        radius = steps * (share + self._motion.translation_length)
        if steps > _MAX_UNGUIDED_STEPS and radius > 2.0 * self.calibration.max_range_metres:
            return None
        heading_for = start
        for _ in range(steps):
            heading_for = heading_for @ self._motion
        return dense.SearchWindow(
            heading_for, math.radians(self.options.search_angle_degrees), radius
        )

    def _predict_from_motion(
        self, keyframe: PreparedFrame, prepared: PreparedFrame
    ) -> Pose2 | None:
        """Return ``keyframe_from_now`` if the robot goes on as it did; None where none is known."""
        if self._motion is None or self._motion_frame != prepared.index - 1:
            return None
        if self._graph[keyframe.index].fragment != self._graph[self._motion_frame].fragment:
            return None
        return self._motion_from(keyframe) @ self._motion

    def _motion_from(self, keyframe: PreparedFrame) -> Pose2:
        """Return ``keyframe_from_latest`` of the frame whose motion is the latest known."""
        return self._graph.pose(keyframe.index).inverse() @ self._graph.pose(self._motion_frame)

    def _register(
        self,
        keyframe: PreparedFrame,
        prepared: PreparedFrame,
        guess: Pose2 | None = None,
        *,
        window: dense.SearchWindow | None = None,
        expected: Pose2 | None = None,
    ) -> RegistrationResult:
        calibration, options = self.calibration, self.options
        return register(
            keyframe, prepared, guess, calibration, options, window=window, expected=expected
        )

    def _predict_from_link(
        self, believed: RegistrationResult, keyframe: PreparedFrame
    ) -> Pose2 | None:
        """Return ``keyframe_from_now`` by way of a believed trial; None for another fragment."""
        assert believed.link is not None
        known, other = believed.keyframe.index, keyframe.index
        if self._graph[known].fragment != self._graph[other].fragment:
            return None
        other_from_known = self._graph.pose(other).inverse() @ self._graph.pose(known)
        return other_from_known @ believed.link.a_from_b

    def _insert(self, prepared: PreparedFrame, trials: list[RegistrationResult]) -> PoseEstimate:
        """Place a frame by its believed links; a keyframe if it shows enough new floor."""
        believed = [trial for trial in trials if trial.link is not None]
        links = [trial.link for trial in believed if trial.link is not None]
        estimate = self._graph.place(prepared, links)
        before = self._graph.get(prepared.index - 1)
        self._motion = None
        if before is not None and before.fragment == estimate.fragment:
            start = self._graph.pose(before.index)
            self._motion = start.inverse() @ self._graph.pose(prepared.index)
            self._motion_frame = prepared.index
        stray, self._last_lost, self._last_placed = self._last_lost, None, prepared
        overlap = max(trial.overlap for trial in believed)
        if overlap < self.options.keyframe_overlap or links[0].kind == "loop":
            self._add_keyframe(prepared)
            estimate = self._join_fragments(prepared)
            if links[0].kind != "loop":
                estimate = self._close_loop(prepared)
        if stray is not None and not self._graph.is_placed(stray.index):
            return self._retry_last_lost(prepared, stray)
        return estimate

    def _retry_last_lost(self, prepared: PreparedFrame, stray: PreparedFrame) -> PoseEstimate:
        """Try the latest lost frame beside the one after it, which shows more of the same floor."""
        trial = self._register(prepared, stray, window=self._window_back(prepared, stray))
        self._trials.append(trial)
        if trial.link is None:
            return self._graph[prepared.index]
        self._graph.place(stray, [trial.link])
        return self._graph.revise(prepared.index, (stray.index,))

    def _window_back(
        self, prepared: PreparedFrame, stray: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return where a lost frame may lie for a later one: between it and the one before."""
        before = self._graph.get(stray.index - 1)
        here = self._graph[prepared.index]
        if before is None or before.fragment != here.fragment or before.map_from_robot is None:
            return self._window_everywhere(stray, prepared)
        way = self._graph.pose(prepared.index).inverse() @ before.map_from_robot
        share = (prepared.index - stray.index) / (prepared.index - before.index)
        near = Pose2(share * way.x, share * way.y, share * way.theta)
        radius = self.options.search_share_of_range * self.calibration.max_range_metres
        angle = math.radians(self.options.search_angle_degrees)
        return dense.SearchWindow(near, angle, radius + share * way.translation_length)

    def _join_fragments(self, keyframe: PreparedFrame) -> PoseEstimate:
        """Tie a new keyframe to a map that it was apart from, if it recalls one."""
        if self.options.loops:
            found = self._loops.join_fragments(keyframe, self._graph).trial
            if found is not None and found.link is not None:
                self._trials.append(found)
                self._graph.add_links(keyframe.index, [found.link])
        return self._graph[keyframe.index]

    def _close_loop(self, keyframe: PreparedFrame) -> PoseEstimate:
        """Tie a new keyframe to floor of its own fragment that was seen long before."""
        if self.options.loops:
            link = self._loops.close_on_arrival(keyframe, self._graph)
            if link is not None:
                self._graph.add_links(keyframe.index, [link])
        return self._graph[keyframe.index]

    def _begin_fragment(self, prepared: PreparedFrame) -> PoseEstimate:
        self._last_placed = prepared
        self._add_keyframe(prepared)
        return self._graph.begin_fragment(prepared)

    def _add_keyframe(self, prepared: PreparedFrame) -> None:
        self._keyframes.append(prepared)
        self._loops.add(prepared)
        del self._keyframes[: -self.options.recent_keyframes]


def _most_informative(trials: list[RegistrationResult]) -> RegistrationResult:
    """Return the trial that tells best why a frame is lost: the one that asked the pixels too."""
    return next((trial for trial in trials if trial.search is not None), trials[0])


def _same_picture(a: PreparedFrame, b: PreparedFrame) -> bool:
    assert a.view is not None
    assert b.view is not None
    return np.array_equal(a.view.image, b.view.image) and np.array_equal(a.view.mask, b.view.mask)
