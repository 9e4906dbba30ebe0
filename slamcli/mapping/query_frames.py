"""Preparation of a frame that is to be located: at half the resolution first.

Half the resolution of the views that are compared still places a frame within hundredths of a
millimetre, at a quarter of the work; a few of the points that a map's keyframes have are enough to
find their place. A frame that cannot be placed by them is prepared at the full resolution.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.config import FeatureOptions, MapperOptions
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2
from slamcli.core.records import Features, Frame, PreparedFrame, View
from slamcli.mapping.preprocessing import Preprocessor, prepared_or_refused
from slamcli.registration.preparation import assemble, make_pyramids
from slamcli.stages import dense, features, view

# Points are detected in a view that is coarser by the map's scale factor to a whole power: its
# levels are then those of the keyframes, without the finest. Of the points that votes need, 50 or
# more agree with the motion, where 36 are required
# [benchmarks/locate.py: 16 votes at least of 10,000 keyframes at 1.73, 10 at 2.07].
_MAX_COARSER = 1.75
_MAX_POINTS = 200


class QueryPreprocessor:
    """Makes frames of one camera ready to be located.

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
        self.full = Preprocessor(calibration, options)
        self._calibration = calibration
        resolution = resolution_image(calibration)
        self._resampler = view.make_resampler(
            calibration, resolution, self.full.grid.halved, Pose2(), antialias=True
        )
        self._masks = dense.make_level_masks(self._resampler.mask)
        octaves, self._features = _coarser(options.features)
        coarser = options.features.scale_factor**octaves
        self._painter = view.make_view_resampler(calibration, coarser * self.full.metres_per_pixel)

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Return the prepared frame, or one with the reason why it cannot be used; never raises.

        Its pyramid is that of half the resolution where that has enough levels.
        """
        if not self.full.can_be_halved:
            return self.full.prepare(frame)
        return prepared_or_refused(frame, self._calibration, self._prepare)

    def _prepare(self, frame: Frame) -> PreparedFrame:
        frame = replace(frame, image=view.to_gray(frame.image))
        views = view.make_compared_views(frame, [self._resampler])
        view.check_view(views[0])
        painting = Deferred(partial(view.make_view, frame, self._painter, gray=True))
        extraction = Deferred(partial(self._extract, painting))
        masks = None if frame.mask is not None else [self._masks]
        pyramids = Deferred.of(make_pyramids(views, masks))
        prepared = assemble(frame, pyramids, painting, extraction)
        return replace(prepared, finer=Deferred(partial(self.full.prepare, frame)))

    def _extract(self, painting: Deferred[View]) -> Features:
        return features.extract(painting.value, self._calibration, self._features)


def _coarser(options: FeatureOptions) -> tuple[int, FeatureOptions]:
    """Return how many of ORB's finest levels are left out, and the options for the rest."""
    octaves = min(int(math.log(_MAX_COARSER, options.scale_factor)), options.levels - 1)
    # Votes need neither points that are spread evenly nor fractions of a pixel.
    count = min(options.count, _MAX_POINTS)
    levels = options.levels - octaves
    return octaves, replace(options, count=count, levels=levels, spread=False, refine=False)
