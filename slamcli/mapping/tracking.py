"""Tracking: registers a frame to the latest keyframes, and selects the next keyframe."""

from __future__ import annotations

from dataclasses import replace

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame
from slamcli.mapping import camera_tilt
from slamcli.mapping.motion_model import MAX_UNGUIDED_STEPS, MotionModel
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult, direct, register
from slamcli.registration.marks import is_unmistakable
from slamcli.stages import dense

# A second link confirms the first, however little floor it shares. A third that shares less than
# this does not improve a steady camera's pose, and worsens a rocking one's.
# [guarded by benchmarks/robustness.py, rocking]
_MIN_OVERLAP_OF_THIRD = 0.4
# Share of the informative patches that must agree with the motion of a frame that fits no map: half
# of a hand before the lens agrees with one [benchmarks/kidnap.py: up to 0.52].
_MIN_CONFIRMED_OF_LOST = 0.6
# What a frame shares with a keyframe is less by up to this where its borders are left out: within
# it, it may become a keyframe, which is not tracked sparsely [benchmarks/streaming.py: 0.013].
_MARGIN_OF_OVERLAP = 0.015


class Tracker:
    """Registration of each frame to the latest keyframes, guided by the motion model.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    tracking : TrackingState
        Read, not changed.
    motion_model : MotionModel
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions,
        tracking: TrackingState,
        motion_model: MotionModel,
    ) -> None:
        self._calibration = calibration
        self._options = options
        self._options_of_known = replace(options, max_turn_degrees=180.0)
        self._tracking = tracking
        self._motion_model = motion_model

    def track(
        self, prepared: PreparedFrame, before: PreparedFrame | None
    ) -> list[RegistrationResult]:
        """Register a frame to the latest keyframes, those that see most of its floor first.

        After the first accepted registration, older keyframes are used while its overlap is small
        and theirs is large enough. Without an accepted one, the frame is registered to the latest
        placed one by its pixels.

        Parameters
        ----------
        prepared : PreparedFrame
        before : PreparedFrame or None
            The frame before it that could be used.
        """
        results: list[RegistrationResult] = []
        for keyframe in self._by_expected_overlap(prepared):
            accepted = [(r, r.link) for r in results if r.link is not None]
            guess = None
            if accepted:
                result, link = accepted[0]
                if result.overlap >= self._options.keyframe_overlap:
                    break
                guess = self._motion_model.predict_from_link(keyframe, link)
                third = len(accepted) >= 2
                min_overlap = _MIN_OVERLAP_OF_THIRD if third else self._options.min_overlap
                if guess is None or _overlap(keyframe, prepared, guess) < min_overlap:
                    continue
            results.append(
                self._track_directly(keyframe, prepared, guess)
                or self.register(keyframe, prepared, guess)
            )
        if any(result.link is not None for result in results):
            return results
        return results + self._track_by_pixels(prepared, before)

    def track_sparsely(self, prepared: PreparedFrame) -> RegistrationResult | None:
        """Register a frame to the newest keyframe by its sparse view; None where that fails.

        It is tried where the frame is expected to show little new, by what is known of how the
        robot moves, and the camera does not rock.
        """
        if not self.is_steady(prepared):
            return None
        newest = self._tracking.keyframes[-1]
        prior = self._motion_model.prior(newest, prepared)
        return None if prior is None else self._track_sparsely(newest, prepared, prior)

    def is_steady(self, prepared: PreparedFrame) -> bool:
        """Return whether a frame can be tracked by its sparse view, and the camera is steady."""
        options, tracking = self._options, self._tracking
        return (
            options.dense
            and options.refine
            and bool(tracking.keyframes)
            and not camera_tilt.is_shown(tracking.tilts_radians, options)
            and prepared.sparse.value is not None
        )

    def track_closely(
        self, keyframe: PreparedFrame, prepared: PreparedFrame, prior: dense.MotionPrior
    ) -> RegistrationResult | None:
        """Register a frame that shares less with the newest keyframe; by its sparse view if it can.

        None where its pixels do not prove the motion.
        """
        options = replace(
            self._options_of(keyframe), keyframe_overlap=direct.MIN_OVERLAP_OF_PERIODS
        )
        sparsely = self._track_sparsely(keyframe, prepared, prior, options)
        return sparsely or self._track_directly(keyframe, prepared, None)

    def track_known(
        self, keyframe: PreparedFrame, prepared: PreparedFrame, prior: dense.MotionPrior
    ) -> RegistrationResult | None:
        """Register a frame to a keyframe of floor that is seen again, by its sparse view alone."""
        return self._track_sparsely(keyframe, prepared, prior, self._options_of_known)

    def _track_sparsely(
        self,
        keyframe: PreparedFrame,
        prepared: PreparedFrame,
        prior: dense.MotionPrior,
        options: MapperOptions | None = None,
    ) -> RegistrationResult | None:
        options, sparse = options or self._options_of(keyframe), prepared.sparse.value
        assert sparse is not None
        expected = dense.overlap(keyframe.levels[1], sparse.second, prior.a_from_b)
        if expected < options.keyframe_overlap + _MARGIN_OF_OVERLAP:
            return None
        return direct.track_sparsely(keyframe, prepared, sparse, self._calibration, options, prior)

    def _options_of(self, keyframe: PreparedFrame) -> MapperOptions:
        """Return the options for a keyframe: floor that is seen again may lie at any angle."""
        revisited = keyframe.index in self._tracking.revisited
        return self._options_of_known if revisited else self._options

    def is_keyframe(self, results: list[RegistrationResult]) -> bool:
        """Keyframe selection: a frame becomes one that shares little floor with the keyframes.

        So does a relocalised one, as the keyframes before it lie elsewhere.
        """
        accepted = [result for result in results if result.link is not None]
        overlap = max(result.overlap for result in accepted)
        first = accepted[0].link
        return overlap < self._options.keyframe_overlap or (
            first is not None and first.kind == "loop"
        )

    def register(
        self,
        keyframe: PreparedFrame,
        prepared: PreparedFrame,
        guess: Pose2 | None = None,
        *,
        window: dense.SearchWindow | None = None,
    ) -> RegistrationResult:
        """Register one frame to another; the parameters are those of `registration.register`."""
        calibration, options = self._calibration, self._options
        prior = self._motion_model.prior(keyframe, prepared)
        result = register(
            keyframe, prepared, guess, calibration, options, window=window, prior=prior
        )
        result = camera_tilt.without_unusual(result, self._tracking.tilts_radians, options)
        steps = abs(prepared.index - keyframe.index)
        if prior is None and steps > MAX_UNGUIDED_STEPS:
            return self._without_mistakable(result)
        return result

    def _without_mistakable(self, result: RegistrationResult) -> RegistrationResult:
        """Return a result without its link where the floor looks the same elsewhere.

        A keyframe of another fragment may lie anywhere: what it shows is then a place to be found.
        """
        if result.link is None or result.fit is None:
            return result
        keyframe, prepared = result.keyframe, result.prepared
        if is_unmistakable(keyframe, prepared, result.fit, self._calibration):
            return result
        reason = (
            "ambiguous: the floor repeats, and few of its marks are where this motion puts them "
            f"(to {keyframe.name})"
        )
        return replace(result, link=None, reason=reason)

    def _by_expected_overlap(self, prepared: PreparedFrame) -> list[PreparedFrame]:
        """Return the latest keyframes: the newest first, unless a robot that turned back left it.

        An older one may then see all of the frame's floor.
        """
        newest_first = self._tracking.keyframes[::-1]
        shares: list[float] = []
        for keyframe in newest_first:
            prior = self._motion_model.prior(keyframe, prepared)
            if prior is None:
                return newest_first
            shares.append(_overlap(keyframe, prepared, prior.a_from_b))
            if shares[0] >= self._options.keyframe_overlap:
                return newest_first
        order = sorted(range(len(shares)), key=lambda number: -shares[number])
        return [newest_first[number] for number in order]

    def _track_directly(
        self, keyframe: PreparedFrame, prepared: PreparedFrame, guess: Pose2 | None
    ) -> RegistrationResult | None:
        """Register a frame by pixels alone from where it is expected; None where that fails."""
        options = self._options_of(keyframe)
        prior = self._motion_model.prior(keyframe, prepared)
        if prior is None or not (options.dense and options.refine):
            return None
        start = prior.a_from_b if guess is None else guess
        return direct.track(keyframe, prepared, start, self._calibration, options, prior)

    def _track_by_pixels(
        self, prepared: PreparedFrame, before: PreparedFrame | None
    ) -> list[RegistrationResult]:
        """Register a frame to the latest placed one: in a window, then about the latest motion."""
        if not self._tracking.keyframes:
            return []
        newest = self._tracking.keyframes[-1]
        recent = self._tracking.last_placed or newest
        attempts: list[tuple[Pose2 | None, dense.SearchWindow | None]] = []
        window = self._motion_model.window(recent, prepared)
        if (self._options.dense and window is not None) or recent is not newest:
            attempts.append((None, window))
        # Near a guess, descriptors compete with fewer others.
        if self._tracking.motion is not None and recent is before:
            attempts.append((self._tracking.motion, None))
        results = []
        for guess, window in attempts:
            results.append(self.register(recent, prepared, guess, window=window))
            if results[-1].link is not None:
                break
        return results


def is_mostly_confirmed(result: RegistrationResult) -> bool:
    """Return whether most of what two frames show agrees with their motion.

    Required where one was lost, or both were: they begin a map of their own then.
    """
    return not result.confirmed < _MIN_CONFIRMED_OF_LOST


def _overlap(keyframe: PreparedFrame, prepared: PreparedFrame, guess: Pose2) -> float:
    return dense.overlap(keyframe.levels[0], prepared.levels[0], guess)
