"""Bounds of quantities: which numbers an option, a field of a table or a key of a file may have.

One place for all three, so that what one of them refuses no other accepts. Every bound is finite
and no comparison with nan is true: neither nan nor infinity ever is within bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from reprlib import Repr
from typing import Any

# Texts of values are quoted in messages up to this length.
_MAX_QUOTED = 40
# Of nested lists, which may share parts, so that the whole text could have billions of characters.
_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict = 3, 4, 4, 4
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 2 * _MAX_QUOTED


@dataclass(frozen=True, slots=True)
class Bounds:
    """An interval of numbers.

    Attributes
    ----------
    low, high : float
    open_low, open_high : bool
        The end itself is outside.
    whole : bool
        Only integers are inside.
    """

    low: float
    high: float
    open_low: bool = False
    open_high: bool = False
    whole: bool = False

    def __contains__(self, value: object) -> bool:
        """Return whether a value is a number (no bool) in the interval; nan never is."""
        if isinstance(value, bool) or not isinstance(value, int if self.whole else int | float):
            return False
        above = self.low < value if self.open_low else self.low <= value
        return above and (value < self.high if self.open_high else value <= self.high)

    def __str__(self) -> str:
        """Return the interval as messages show it."""
        kind = "a whole number" if self.whole else "a number"
        low = f"above {self.low:g}" if self.open_low else f"from {self.low:g}"
        high = f"to below {self.high:g}" if self.open_high else f"to {self.high:g}"
        return f"{kind} {low} {high}"

    def scaled(self, factor: float) -> Bounds:
        """Return the interval in another unit."""
        return replace(self, low=self.low * factor, high=self.high * factor)


def quoted(value: Any) -> str:
    """Return a value as messages show it: what has thousands of digits or elements is cut."""
    try:
        text = value if isinstance(value, str) else _SHORT.repr(value)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    text = text if len(text) <= _MAX_QUOTED else f"{text[: _MAX_QUOTED - 3]}..."
    return repr(text) if isinstance(value, str) else text


# Lengths are metres, or pixels for frames without a calibration. What is outside is damage: far
# smaller or larger than anything on any floor, and still exact to a micrometre in a float.
LENGTH = Bounds(1e-6, 1e7)
LENGTH_OR_ZERO = Bounds(0.0, 1e7)
COORDINATE = Bounds(-1e7, 1e7)
METRES_PER_PIXEL = Bounds(1e-6, 1e4)
# A sigma beyond these makes equations that no float64 can solve beside those of the frames.
SIGMA_METRES = Bounds(1e-6, 1e7)
SIGMA_RADIANS = Bounds(1e-6, 1e3)
# Of a reading: below 1e-6 it is not known, as loggers write 0 for what they have no value of.
READING_SIGMA_METRES = Bounds(0.0, SIGMA_METRES.high)
READING_SIGMA_RADIANS = Bounds(0.0, SIGMA_RADIANS.high)
# Radians that were added up turn after turn.
ANGLE = Bounds(-1e6, 1e6)
LATITUDE_DEGREES = Bounds(-90.0, 90.0)
LONGITUDE_DEGREES = Bounds(-360.0, 360.0)
# Seconds since any epoch: to the year 33,000, and exact to a millisecond.
STAMP = Bounds(-1e12, 1e12)
SECONDS_OR_ZERO = Bounds(0.0, 1e9)
TIME_STEP = Bounds(1e-6, 1e6)
SHARE = Bounds(0.0, 1.0)
SHARE_ABOVE_ZERO = Bounds(0.0, 1.0, open_low=True)
HALF_TURN_DEGREES = Bounds(0.0, 180.0)
TILT_DEGREES = Bounds(0.0, 90.0)
FACTOR = Bounds(1.0, 1e6)
HERTZ = Bounds(1e-6, 1e6)
MAX_IMAGE_SIDE = 32_768
# More than any sensor has; what is computed for every pixel of a picture takes a gigabyte.
MAX_IMAGE_PIXELS = 160_000_000
MAX_POINTS = 100_000
MAX_SEED = 2**63 - 1
SEED = Bounds(0, MAX_SEED, whole=True)
# Of a frame in its sequence; `map.slam` has no larger ones.
FRAME_INDEX = Bounds(0, 2**31 - 2, whole=True)
WORKERS = Bounds(1, 1024, whole=True)
COUNT = Bounds(1, 1_000_000, whole=True)
# By the names of `FeatureOptions`; those of ORB are OpenCV's own.
FEATURES = {
    "count": Bounds(1, MAX_POINTS, whole=True),
    "scale_factor": Bounds(1.01, 4.0),
    "levels": Bounds(1, 32, whole=True),
    "edge_threshold": Bounds(1, 1024, whole=True),
    "first_level": Bounds(0, 31, whole=True),
    "wta_k": Bounds(2, 4, whole=True),
    "patch_size": Bounds(5, 1024, whole=True),
    "fast_threshold": Bounds(1, 255, whole=True),
    "min_fast_threshold": Bounds(1, 255, whole=True),
    "contrast_threshold": Bounds(0.0, 1e3),
    "clean_kernel_pixels": Bounds(1, 1024, whole=True),
    "clean_threshold": Bounds(0, 255, whole=True),
    "roi_border_pixels": Bounds(0, 4096, whole=True),
}
