"""Preprocessing: a frame's bird's-eye views, features and pyramids, which need no other frame."""

from __future__ import annotations

import math
from collections.abc import Callable
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
from slamcli.core.records import Features, Frame, PreparedFrame, View
from slamcli.mapping.frame_checks import checked_frame, refused
from slamcli.mapping.keyframes import can_be_halved
from slamcli.registration.preparation import assemble
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

    @property
    def grid(self) -> Grid:
        """Of the near view that is compared, in the robot frame."""
        return self._resamplers[0].grid

    @property
    def can_be_halved(self) -> bool:
        """Whether the compared view has levels enough at half its resolution."""
        return can_be_halved(self._masks[0])

    def prepare(self, frame: Frame, rocking: Rocking | None = None) -> PreparedFrame:
        """Return the prepared frame, or one with the reason why it cannot be used; never raises.

        Parameters
        ----------
        frame : Frame
        rocking : Rocking or None
            Its pitch, roll and height beside the calibration, where they are known.
        """
        prepare = partial(self._prepare, rocking=rocking)
        return prepared_or_refused(frame, self._calibration, prepare)

    def _prepare(self, frame: Frame, rocking: Rocking | None) -> PreparedFrame:
        resampler, resamplers = self._resampler, self._resamplers
        if rocking is not None:
            resampler = self._of_rocked(rocking, resampler.grid)
            resamplers = [self._of_rocked(rocking, self.grid, antialias=True)]
        views = view.make_compared_views(frame, resamplers)
        view.check_view(views[0])
        painting = Deferred(partial(view.make_view, frame, resampler, gray=True))
        extraction = Deferred(partial(self._extract, painting))
        # With a mask or a tilt of its own, a frame's views have other masks than the camera's.
        shared = rocking is None and frame.mask is None
        return assemble(frame, views, painting, extraction, self._masks if shared else None)

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
