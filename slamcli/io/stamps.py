"""Stamps in the names of files: seconds, milliseconds, microseconds or nanoseconds since 1970.

A number in a name may as well be a counter. It is taken as a time only if all names of a series
have one, alike, and together they make a plausible one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

# A prefix that all names share, and a number; the fraction as `str(time.time())` writes it.
_NAME = re.compile(r"(?P<prefix>[^\d]*)(?P<whole>\d{1,19})(?:\.(?P<fraction>\d{1,18}))?")
# The number of digits of whole seconds, and of their parts, in this century.
_UNITS = {10: 1, 13: 10**3, 16: 10**6, 19: 10**9}
_YEAR_2000, _YEAR_2100 = 946_684_800, 4_102_444_800
# A number that is not since 1970 is a time only with so many decimals, as "0.033333".
_MIN_DECIMALS = 3


@dataclass(frozen=True, slots=True)
class NameStamps:
    """The stamps of a series of names.

    Attributes
    ----------
    seconds : tuple of float
        One for each name.
    sure : bool
        Whether they can hardly be anything else: parts of a second since 1970.
    """

    seconds: tuple[float, ...]
    sure: bool


def stamps_of_names(stems: Sequence[str]) -> NameStamps | None:
    """Return the stamps in names without their suffixes; None when they are no plausible series."""
    found = [_NAME.fullmatch(stem) for stem in stems]
    matches = [match for match in found if match is not None]
    if not matches or len(matches) < len(stems):
        return None
    if len({match["prefix"] for match in matches}) > 1:
        return None
    since_1970 = _since_1970(matches)
    if since_1970 is None:
        decimals = {len(match["fraction"] or "") for match in matches}
        if len(decimals) > 1 or decimals.pop() < _MIN_DECIMALS:
            return None
    values = since_1970 or [Fraction(f"{m['whole']}.{m['fraction']}") for m in matches]
    if len(set(values)) < len(values):
        return None
    # To the microsecond, which a double holds.
    seconds = tuple(float(round(value * 10**6)) / 1e6 for value in values)
    return NameStamps(seconds, since_1970 is not None and any(v.denominator > 1 for v in values))


def _since_1970(matches: Sequence[re.Match[str]]) -> list[Fraction] | None:
    """Return seconds since 1970; None when not all numbers are of one unit and in this century."""
    lengths = {len(match["whole"]) for match in matches}
    fractions = any(match["fraction"] for match in matches)
    # Before September 2001 the seconds have nine digits.
    unit = _UNITS.get(max(lengths)) if max(lengths) != 9 else 1
    if unit is None or (fractions and unit != 1) or max(lengths) - min(lengths) > 1:
        return None
    values = [Fraction(f"{m['whole']}.{m['fraction'] or 0}") / unit for m in matches]
    if not all(_YEAR_2000 <= value < _YEAR_2100 for value in values):
        return None
    return values
