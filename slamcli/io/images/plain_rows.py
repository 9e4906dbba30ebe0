"""Dead stretches of uncompressed pixels: rows of zeros or ones that no camera has seen.

Such files carry no check. What was never written, or was erased, begins and ends in the middle of a
row: its border is a staircase of two steps, a row apart, as wide as the picture, with clearly other
pixels all along it. A black border, a black floor or a saturated one has none; a thin black line
that is nearly level may have one, beside other black pixels. Then the stretch must also begin or
end at a block of a disk or within a pixel.

One that begins and ends with a row looks like a bar of a letterbox, and neither is floor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamcli.core.arrays import BoolArray, UInt8Array
from slamcli.core.errors import FrameError

_DEAD = {0: "zero", 255: "erased (bytes of ones)"}
# Of a row's bytes, so many apart, that are looked at first: an odd number meets each channel.
_SAMPLE_BYTES = 101
# What is dead has at least so many whole rows.
_MIN_ROWS = 2
# Each step of the staircase is at least this share of a row, and a pixel.
_MIN_STEP_SHARE = 0.005
# Levels by which a pixel at the border differs clearly, and the share of them that must.
# [guarded by benchmarks/damaged_pictures.py]
_MIN_LEVELS, _MIN_CLEAR_SHARE = 4, 0.9
# With a larger share of other pixels of the same value, it is one that this picture has.
_MAX_OTHER_SHARE = 1e-4
_BLOCK_BYTES = 512


@dataclass(frozen=True, slots=True, eq=False)
class PlainRows:
    """The pixels of a file without compression.

    Attributes
    ----------
    rows : (H, W bytes a pixel) uint8
        In the order of the file.
    pixel_bytes : int
    offset, stride : int
        Of the first row in the file, and from row to row, bytes.
    """

    rows: UInt8Array
    pixel_bytes: int
    offset: int
    stride: int


class _Stretch(NamedTuple):
    """Whole rows of a stretch: the first, and the one after the last."""

    first: int
    end: int


def plain_rows(
    data: bytes, offset: int, stride: int, shape: tuple[int, int], pixel_bytes: int
) -> PlainRows:
    """Return the rows of a file that has them all, of a picture's height and width."""
    height, width = shape
    count = stride * (height - 1) + width * pixel_bytes
    whole = np.frombuffer(data, np.uint8, count, offset)
    rows = np.lib.stride_tricks.as_strided(
        whole, (height, width * pixel_bytes), (stride, 1), writeable=False
    )
    return PlainRows(rows, pixel_bytes, offset, stride)


def check_dead_rows(plain: PlainRows) -> None:
    """Raise FrameError when a stretch of the rows is dead."""
    for value, word in _DEAD.items():
        stretches = list(_stretches(plain.rows, value))
        others = np.ones(len(plain.rows), np.bool_)
        for stretch in stretches:
            others[max(stretch.first - 1, 0) : stretch.end + 1] = False
        for stretch in stretches:
            found = _borders(plain, stretch)
            if found and all(border.is_staircase(value) for border in found):
                has_mark = any(border.has_mark(value) for border in found)
                if has_mark or not _is_usual(plain, others, value):
                    raise FrameError(f"damaged: a stretch of the file is {word}")


def find_bars(plain: PlainRows) -> BoolArray:
    """Return (H,): the rows of bars of zeros or ones across the picture, clearly bordered."""
    bars = np.zeros(len(plain.rows), np.bool_)
    for value in _DEAD:
        for stretch in _stretches(plain.rows, value):
            found = _borders(plain, stretch)
            if found and all(border.is_level(value) for border in found):
                # Also the rows that belong to it in part.
                bars[max(stretch.first - 1, 0) : stretch.end + 1] = True
    return bars


def _stretches(rows: UInt8Array, value: int) -> Iterator[_Stretch]:
    """Yield the stretches of a value, with their whole rows."""
    suspect = np.flatnonzero((rows[:, ::_SAMPLE_BYTES] == value).all(axis=1))
    whole = suspect[(rows[suspect] == value).all(axis=1)]
    for group in np.split(whole, np.flatnonzero(np.diff(whole) > 1) + 1):
        if len(group) >= _MIN_ROWS:
            yield _Stretch(int(group[0]), int(group[-1]) + 1)


def _borders(plain: PlainRows, stretch: _Stretch) -> list[_Border]:
    """Return the borders of a stretch within the picture, each seen from the stretch."""
    rows, first, end = plain.rows, stretch.first, stretch.end
    found = []
    if first:
        outer = rows[first - 2, ::-1] if first > 1 else None
        found.append(_Border(plain, rows[first - 1, ::-1], outer, first, -1))
    if end < len(rows):
        outer = rows[end + 1] if end + 1 < len(rows) else None
        found.append(_Border(plain, rows[end], outer, end, 1))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Border:
    """One end of a stretch: bytes of a row that belong to it, and what lies beside it.

    Attributes
    ----------
    plain : PlainRows
    inner : (W bytes a pixel,) uint8
        The row in which the stretch ends, from its side.
    outer : (W bytes a pixel,) uint8 or None
        The row beyond, in the same direction; None at the border of the picture.
    row : int
        Where the stretch's whole rows begin or end.
    direction : int
        1 at the end of the stretch, -1 at its start.
    """

    plain: PlainRows
    inner: UInt8Array
    outer: UInt8Array | None
    row: int
    direction: int

    def is_staircase(self, value: int) -> bool:
        """Return whether the border has two steps, with clearly other pixels along both."""
        dead, width = self._dead_bytes(value), len(self.inner)
        size = self.plain.pixel_bytes
        if min(dead, width - dead) < max(size, _MIN_STEP_SHARE * width):
            return False
        beside = [self.inner[-(-dead // size) * size :]]
        if self.outer is not None:
            beside.append(self.outer[: dead // size * size])
        return all(_is_clear(pixels, size, value) for pixels in beside)

    def is_level(self, value: int) -> bool:
        """Return whether clearly other pixels lie along the whole border, without a step."""
        dead, size = self._dead_bytes(value), self.plain.pixel_bytes
        beside = self.inner[-(-dead // size) * size :]
        if 2 * dead > len(self.inner) and self.outer is not None:
            beside = self.outer
        return _is_clear(beside, size, value)

    def has_mark(self, value: int) -> bool:
        """Return whether the stretch ends at a block of a disk, or within a pixel."""
        dead, size = self._dead_bytes(value), self.plain.pixel_bytes
        offset = self.plain.offset + self.row * self.plain.stride + self.direction * dead
        if offset % _BLOCK_BYTES == 0:
            return True
        # Pixels of a pure colour have zeros of their own.
        after = self.inner[(dead // size + 1) * size :][:size].reshape(1, -1)
        return dead % size > 0 and bool((_levels(after, size, value) >= _MIN_LEVELS).all())

    def _dead_bytes(self, value: int) -> int:
        return int(np.argmax(self.inner != value))


def _is_clear(pixels: UInt8Array, pixel_bytes: int, value: int) -> bool:
    """Return whether pixels differ clearly from a value, nearly all of them."""
    levels = _levels(pixels, pixel_bytes, value)
    return bool(np.mean(levels.max(axis=1) >= _MIN_LEVELS) >= _MIN_CLEAR_SHARE)


def _levels(row: UInt8Array, pixel_bytes: int, value: int) -> UInt8Array:
    """Return (N, bytes a pixel): how far the bytes of pixels are from a value."""
    levels = row.reshape(-1, pixel_bytes)
    return levels if value == 0 else np.uint8(value) - levels


def _is_usual(plain: PlainRows, others: BoolArray, value: int) -> bool:
    """Return whether some rows have pixels of a value, too."""
    pixels = plain.rows[others].reshape(-1, plain.pixel_bytes)
    return bool(np.count_nonzero((pixels == value).all(axis=1)) > _MAX_OTHER_SHARE * len(pixels))
