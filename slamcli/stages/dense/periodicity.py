"""Periodicity of a floor: the shifts by which a view looks like itself."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.records import PyramidLevel
from slamcli.stages.dense.correlation_search import autocorrelation

# A shift is a period from this correlation on, and where this share of the view still overlaps
# [guarded by benchmarks/robustness.py: tiles, identical-tiles].
_MIN_CORRELATION = 0.4
_MIN_OVERLAP = 0.2
# Within this many pixels of no shift every view looks like itself.
_OWN_PEAK_PIXELS = 5
_MAX_SHIFTS = 4
# Of the highest correlation; the periods of a lattice differ by less
# [benchmarks/tiles.py, 0.20 m without marks: six false loops by the print's own 0.06 m alone].
_STRONG_SHARE = 0.75
_AROUND_PIXELS = 2
_AROUND = np.ones((2 * _AROUND_PIXELS + 1,) * 2, np.uint8)
# Fewer pixels correlate by chance [guarded by tests/stages/test_periodicity.py: concrete].
_MIN_PIXELS = 8000


def find_periods(levels: Sequence[PyramidLevel]) -> Float64Array:
    """Return (K, 2) shifts, metres in the robot's axes, by which a view looks like itself.

    The strong ones before the weak ones, the shortest first, to a pixel of the coarsest level that
    has enough of them; one of each pair of opposite ones. None on a floor that does not repeat.
    """
    enough = (one for one in reversed(levels) if cv2.countNonZero(one.inside) >= _MIN_PIXELS)
    level = next(enough, levels[0])
    correlation, shared = autocorrelation(level, _MIN_OVERLAP, _AROUND_PIXELS)
    peaks = (correlation >= _MIN_CORRELATION) & (shared >= _MIN_OVERLAP)
    peaks[:_AROUND_PIXELS] = False
    found = np.argwhere(peaks)
    pixels = found - (_AROUND_PIXELS, correlation.shape[1] // 2)
    length = np.hypot(*pixels.T)
    far = length > _OWN_PEAK_PIXELS
    if not far.any():
        return np.empty((0, 2))
    highest = cv2.dilate(correlation, _AROUND)[*found.T]
    values = correlation[*found.T]
    is_peak = far & (values == highest)
    pixels, length, values = pixels[is_peak], length[is_peak], values[is_peak]
    # What a tile's own print has in common with itself is less than what two tiles have.
    strong = values >= _STRONG_SHARE * values.max(initial=0.0)
    chosen = np.lexsort((length, ~strong))[:_MAX_SHIFTS]
    right, down = pixels[chosen, 1], pixels[chosen, 0]
    shifts: Float64Array = level.metres_per_pixel * np.column_stack([right, -down])
    return shifts
