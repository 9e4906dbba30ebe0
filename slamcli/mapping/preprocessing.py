"""Preprocessing: a frame's bird's-eye views, features and pyramids, which need no other frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.footprint import MAX_REGISTRATION_PIXELS, check_metres_per_pixel
from slamcli.core.camera.mounting import rocked
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.config import MapperOptions
from slamcli.core.deferred import Deferred
from slamcli.core.errors import FrameError
from slamcli.core.failures import FAILURES, logged
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import (
    NO_SPARSE_VIEW,
    Features,
    Frame,
    PreparedFrame,
    Pyramids,
    SparseView,
    View,
)
from slamcli.mapping.frame_checks import checked_frame, refused
from slamcli.mapping.keyframes import can_be_halved
from slamcli.registration.preparation import LevelMasks, assemble, make_pyramids
from slamcli.stages import dense, features, view

# The GNU C library does not follow blocks of 32 MiB and more.
_LARGE_BYTES = 31 * 2**20


class Preprocessor:
    """Makes frames of one camera ready for registration.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions

    Raises
    ------
    CalibrationError, InputError
        When the camera sees no floor, or not at this resolution.
    """

    def __init__(self, calibration: Calibration, options: MapperOptions) -> None:
        self.metres_per_pixel = options.metres_per_pixel or view.registration_metres_per_pixel(
            calibration
        )
        if options.metres_per_pixel is not None:
            check_metres_per_pixel(
                calibration,
                self.metres_per_pixel,
                MAX_REGISTRATION_PIXELS,
                "--view-metres-per-pixel",
            )
        _keep_freed_memory()
        self._calibration = calibration
        self._features = options.features
        self._tilt_radians = math.radians(options.tilt_sigma_degrees)
        self._resampler = view.make_view_resampler(calibration, self.metres_per_pixel)
        self._resamplers = view.make_compared_resamplers(
            calibration, self.metres_per_pixel, far=options.dense
        )
        self._masks = [dense.make_level_masks(resampler.mask) for resampler in self._resamplers]
        self._sparse = Deferred(self._make_reading)

    @property
    def grid(self) -> Grid:
        """Of the near view that is compared, in the robot frame."""
        return self._resamplers[0].grid

    @property
    def can_be_halved(self) -> bool:
        """Whether the compared view has levels enough at half its resolution."""
        return can_be_halved(self._masks[0])

    def prepare(
        self, frame: Frame, rocking: Rocking | None = None, *, lazily: bool = False
    ) -> PreparedFrame:
        """Return the prepared frame, or one with the reason why it cannot be used; never raises.

        Parameters
        ----------
        frame : Frame
        rocking : Rocking or None
            Its pitch, roll and height beside the calibration, where they are known.
        lazily : bool
            Whether its pyramids are made when they are first needed; then they have the reason.
        """
        prepare = partial(self._prepare, rocking=rocking, lazily=lazily)
        return prepared_or_refused(frame, self._calibration, prepare)

    def _prepare(self, frame: Frame, rocking: Rocking | None, *, lazily: bool) -> PreparedFrame:
        # With a mask or a tilt of its own, a frame's views have other masks than the camera's.
        shared = rocking is None and frame.mask is None
        masks = self._masks if shared else None
        pyramids = Deferred(partial(self._make_pyramids, frame, rocking, masks))
        if not lazily and pyramids.value.reason:
            raise FrameError(pyramids.value.reason)
        painting = Deferred(partial(self._paint, frame, rocking))
        extraction = Deferred(partial(self._extract, painting))
        sparse = Deferred(partial(self._make_sparse, frame)) if shared else NO_SPARSE_VIEW
        return assemble(frame, pyramids, painting, extraction, sparse)

    def _make_pyramids(
        self, frame: Frame, rocking: Rocking | None, masks: Sequence[LevelMasks] | None
    ) -> Pyramids:
        """Return a frame's pyramids, or why there are none."""
        try:
            resamplers = self._resamplers
            if rocking is not None:
                resamplers = [self._of_rocked(rocking, self.grid, antialias=True)]
            views = view.make_compared_views(frame, resamplers)
            view.check_view(views[0])
            return make_pyramids(views, masks)
        except FrameError as error:
            return Pyramids(reason=str(error))
        except FAILURES as error:
            return Pyramids(reason=f"cannot be processed: {logged(error)}")

    def _make_sparse(self, frame: Frame) -> SparseView | None:
        """Return a frame's sparse view; None where it shows nothing that could be matched."""
        reading, resampler = self._sparse.value
        smoothed = dense.smoothed_pictures(view.to_gray(frame.image), reading.most_halvings)
        try:
            second = view.make_view(replace(frame, image=smoothed[0]), resampler, gray=True)
            view.check_view(second)
        except FrameError:
            return None
        return dense.make_sparse_view(smoothed, second, reading)

    def _make_reading(self) -> tuple[dense.FloorReading, view.Resampler]:
        """Return where frames are read for their sparse views, and how the second level is.

        That is read from pictures that are smoothed already.
        """
        resampler = view.make_resampler(
            self._calibration, resolution_image(self._calibration), self.grid.halved, Pose2()
        )
        return dense.FloorReading.of(self._calibration, self.grid, self._masks[0]), resampler

    def _paint(self, frame: Frame, rocking: Rocking | None) -> View:
        """Return the gray view that a frame's features are detected in."""
        resampler = self._resampler
        if rocking is not None:
            resampler = self._of_rocked(rocking, resampler.grid)
        return view.make_view(frame, resampler, gray=True)

    def _of_rocked(
        self, rocking: Rocking, grid: Grid, *, antialias: bool = False
    ) -> view.Resampler:
        """Return the resampler of a frame's own pitch, roll and height, for one of the grids.

        The resolution is the camera's, which differs little and takes long to compute.
        """
        resolution = resolution_image(self._calibration)
        own = rocked(self._calibration, rocking)
        return view.make_resampler(own, resolution, grid, Pose2(), antialias=antialias)

    def _extract(self, painting: Deferred[View]) -> Features:
        return features.extract(
            painting.value, self._calibration, self._features, self._tilt_radians
        )


def prepared_or_refused(
    frame: Frame, calibration: Calibration, prepare: Callable[[Frame], PreparedFrame]
) -> PreparedFrame:
    """Return a frame as prepared, or with the reason why it cannot be used; never raises."""
    try:
        return prepare(checked_frame(frame, calibration))
    except FrameError as error:
        reason = str(error)
    except FAILURES as error:
        reason = f"cannot be processed: {logged(error)}"
    return refused(frame, reason)


def _keep_freed_memory() -> None:
    """Have the C library keep memory for the next picture that those of one frame are freed from.

    GNU's returns blocks as large as pictures to the system, which clears them anew for each frame,
    until a larger one was freed: this one, which is never touched
    [benchmarks/streaming.py: a frame takes 6 to 9 % less time].
    """
    np.empty(_LARGE_BYTES, np.uint8)
