"""Floors: textures made block by block from the seed, so that they never end and never repeat.

A block is filtered white noise; the noise of a pixel depends on the seed and its place alone, so
neighbouring blocks meet without a seam.
"""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from slamcli.core.geometry import Grid, apply_homography

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

BLOCK_PIXELS = 512
# Enough for the floor around a robot; older blocks are made again when it comes back.
_MOST_BLOCKS = 600
_LEVELS = 6
# White noise is drawn in pieces of this side: few more pixels than a block and its margin need.
_NOISE_PIXELS = 128

BOARD_METRES = (2.4384, 1.2192)
SQUARE_METRES = 0.3048
LINE_METRES = 0.0254
# The course as we draw it: x along the board from its left end, y from its middle line.
_LINES = (
    ((0.45, -0.56), (0.45, 0.56)),
    ((0.385, 0.0), (0.45, 0.0)),
    ((0.60, 0.0), (2.25, 0.0)),
    ((0.60, 0.0), (0.60, -0.56)),
    ((0.76, 0.0), (0.76, 0.20)),
    ((1.12, 0.0), (1.12, -0.20)),
    ((1.42, 0.0), (1.42, 0.20)),
    ((1.88, 0.0), (1.88, -0.20)),
    ((2.25, 0.0), (2.25, 0.40)),
)
_SQUARES = ((0.08, -0.1524), (0.61, 0.20), (0.97, -0.5048), (1.27, 0.20), (1.73, -0.5048))


class Floor(Protocol):
    """A texture that can be read anywhere, at any scale."""

    metres_per_pixel: float

    def region(self, grid: Grid) -> NDArray[np.uint8]:
        """Return (h, w, 3) uint8 BGR of a grid whose resolution is 2^n times the floor's own."""


class BlockFloor:
    """A floor without end, made block by block; may be shared by threads.

    Parameters
    ----------
    make_block : callable
        Of a grid, at the floor's own resolution, to (h, w, 3) uint8 BGR.
    metres_per_pixel : float
    """

    def __init__(
        self, make_block: Callable[[Grid], NDArray[np.uint8]], metres_per_pixel: float
    ) -> None:
        self.metres_per_pixel = metres_per_pixel
        self._make_block = make_block
        self._lock = Lock()
        self._blocks: OrderedDict[tuple[int, int], list[NDArray[np.uint8]]] = OrderedDict()

    def region(self, grid: Grid) -> NDArray[np.uint8]:
        """Return (h, w, 3) uint8 BGR of a grid whose resolution is 2^n times the floor's own."""
        level = round(np.log2(grid.metres_per_pixel / self.metres_per_pixel))
        side = BLOCK_PIXELS >> level
        left = round(grid.x_min / grid.metres_per_pixel)
        top = round(-grid.y_max / grid.metres_per_pixel)
        image = np.empty((grid.height, grid.width, 3), np.uint8)
        for row in range(top // side, (top + grid.height - 1) // side + 1):
            for column in range(left // side, (left + grid.width - 1) // side + 1):
                y, x = row * side - top, column * side - left
                rows = slice(max(0, y), min(grid.height, y + side))
                columns = slice(max(0, x), min(grid.width, x + side))
                block = self._block(column, row)[level]
                image[rows, columns] = block[
                    rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
                ]
        return image

    def _block(self, column: int, row: int) -> list[NDArray[np.uint8]]:
        """Return a block's pyramid, each level the plain mean of four pixels below."""
        key = (column, row)
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
                return self._blocks[key]
        span = BLOCK_PIXELS * self.metres_per_pixel
        grid = Grid(column * span, -row * span, self.metres_per_pixel, BLOCK_PIXELS, BLOCK_PIXELS)
        levels = [self._make_block(grid)]
        for _ in range(_LEVELS):
            half = levels[-1].shape[0] // 2
            smaller = cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(smaller, np.uint8))
        with self._lock:
            self._blocks[key] = levels
            if len(self._blocks) > _MOST_BLOCKS:
                self._blocks.popitem(last=False)
        return levels


def make_floor(kind: str, wear: float, metres_per_pixel: float, seed: int) -> BlockFloor:
    """Return a floor of a kind in `FLOORS`; `wear` (0 to 1) matters to the course alone."""
    make = FLOORS[kind]
    return BlockFloor(lambda grid: make(grid, wear, seed), metres_per_pixel)


def picture_floor(picture: NDArray[np.uint8], metres_per_pixel: float) -> BlockFloor:
    """Return a picture (H, W, 3) laid on the floor, centred at the origin, mirrored endlessly."""
    height, width = picture.shape[:2]
    mirrored = np.vstack(
        [np.hstack([picture, picture[:, ::-1]]), np.hstack([picture[::-1], picture[::-1, ::-1]])]
    )

    def make(grid: Grid) -> NDArray[np.uint8]:
        left = round(grid.x_min / metres_per_pixel) + width // 2
        top = round(-grid.y_max / metres_per_pixel) + height // 2
        rows = np.arange(top, top + grid.height) % (2 * height)
        columns = np.arange(left, left + grid.width) % (2 * width)
        return np.ascontiguousarray(mirrored[rows[:, None], columns])

    return BlockFloor(make, metres_per_pixel)


def white_noise(grid: Grid, seed: int, margin: int = 0) -> NDArray[np.float32]:
    """Return standard normal pixels, `margin` wider all round, that depend on their place alone."""
    left = round(grid.x_min / grid.metres_per_pixel) - margin
    top = round(-grid.y_max / grid.metres_per_pixel) - margin
    height, width = grid.height + 2 * margin, grid.width + 2 * margin
    noise = np.empty((height, width), np.float32)
    side = _NOISE_PIXELS
    for row in range(top // side, (top + height - 1) // side + 1):
        for column in range(left // side, (left + width - 1) // side + 1):
            # Seeds are natural numbers; the offset keeps those of blocks left of the origin so.
            generator = np.random.default_rng([seed, row + 2**31, column + 2**31])
            block = generator.standard_normal((side, side), dtype=np.float32)
            y, x = row * side - top, column * side - left
            rows = slice(max(0, y), min(height, y + side))
            columns = slice(max(0, x), min(width, x + side))
            noise[rows, columns] = block[
                rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
            ]
    return noise


def smooth_noise(
    grid: Grid, seed: int, sigma_metres: float, stretch: float = 1.0
) -> NDArray[np.float32]:
    """Return (h, w) noise of unit variance with blobs of a size, `stretch` times longer along x.

    Large blobs are made at a coarser scale and enlarged: the same look for a fraction of the work.
    """
    sigma = sigma_metres / grid.metres_per_pixel
    coarse = 1
    while sigma / coarse > 8.0:
        coarse *= 2
    scale = grid.metres_per_pixel * coarse
    margin = int(4 * sigma * max(1.0, stretch) / coarse) + 4
    small = Grid(
        grid.x_min, grid.y_max, scale, -(-grid.width // coarse) + 1, -(-grid.height // coarse) + 1
    )
    noise = white_noise(small, seed, margin)
    sigma_y = max(sigma / coarse, 0.4)
    sigma_x = sigma_y * stretch
    blurred = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma_x, sigmaY=sigma_y))
    # White noise blurred by a Gaussian keeps 1 / (4 pi sigma_x sigma_y) of its variance.
    blurred = blurred * np.float32(np.sqrt(4 * np.pi * sigma_x * sigma_y))
    inner = blurred[margin:-margin, margin:-margin]
    if coarse == 1:
        return np.ascontiguousarray(inner[: grid.height, : grid.width])
    fine = np.arange(grid.width, dtype=np.float32), np.arange(grid.height, dtype=np.float32)
    small_from_fine = small.pixel_from_metres @ grid.metres_from_pixel
    columns = (small_from_fine[0, 0] * fine[0] + small_from_fine[0, 2]).astype(np.float32)
    rows = (small_from_fine[1, 1] * fine[1] + small_from_fine[1, 2]).astype(np.float32)
    at_columns, at_rows = np.meshgrid(columns + margin, rows + margin)
    return np.asarray(cv2.remap(blurred, at_columns, at_rows, cv2.INTER_LINEAR), np.float32)


def _asphalt(grid: Grid, _wear: float, seed: int) -> NDArray[np.uint8]:
    """Paint stones of a few millimetres in a binder, patches, and some light and dark chips."""
    stones = smooth_noise(grid, seed + 1, 0.0016)
    fine = smooth_noise(grid, seed + 2, 0.0007)
    gravel = smooth_noise(grid, seed + 3, 0.0045)
    patches = smooth_noise(grid, seed + 4, 0.06) + smooth_noise(grid, seed + 5, 0.4)
    chips = np.maximum(smooth_noise(grid, seed + 6, 0.0022) - 1.9, 0.0)
    pits = np.maximum(smooth_noise(grid, seed + 7, 0.0030) - 1.7, 0.0)
    gray = 104 + 15 * np.tanh(stones) + 7 * fine + 8 * gravel + 5 * patches
    gray += 70 * chips - 55 * pits
    return _tinted(gray, (1.02, 1.0, 0.98))


def _concrete(grid: Grid, _wear: float, seed: int) -> NDArray[np.uint8]:
    """Paint a trowelled slab: grain, clouds, pores, and the sweep of the trowel."""
    grain = smooth_noise(grid, seed + 11, 0.0008)
    trowel = smooth_noise(grid, seed + 15, 0.003, stretch=4.0)
    clouds = smooth_noise(grid, seed + 12, 0.03) + smooth_noise(grid, seed + 13, 0.15)
    pores = np.maximum(smooth_noise(grid, seed + 14, 0.0017) - 2.2, 0.0)
    stains = np.maximum(smooth_noise(grid, seed + 16, 0.006) - 1.8, 0.0)
    gray = 140 + 3.5 * grain + 4.0 * trowel + 4.0 * clouds - 70 * pores - 25 * stains
    return _tinted(gray, (0.97, 1.0, 1.02))


def _course(grid: Grid, wear: float, seed: int) -> NDArray[np.uint8]:
    """Paint the board on a concrete floor; `wear` 0 is pure black and white."""
    board = _inside_board(grid)
    if wear > 0:
        dark, light = _worn_paints(grid, wear, seed)
        surround = _concrete(grid, wear, seed).astype(np.float32)
    else:
        shape = (grid.height, grid.width)
        dark, light = np.full(shape, 12.0, np.float32), np.full(shape, 235.0, np.float32)
        surround = np.full((grid.height, grid.width, 3), 12.0, np.float32)
    paint = _painted(grid)
    gray = (1.0 - paint) * dark + paint * light
    tinted = gray[..., None] * np.array((1.03, 1.0, 0.98), np.float32)
    mixed = board[..., None] * tinted + (1.0 - board[..., None]) * surround
    return np.asarray(np.clip(np.round(mixed), 0, 255), np.uint8)


def _worn_paints(
    grid: Grid, wear: float, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the black and the white paint, gray (h, w): roller grain, scuffs, seams and dust."""
    grain = smooth_noise(grid, seed + 21, 0.0012)
    roller = smooth_noise(grid, seed + 22, 0.003, stretch=6.0)
    clouds = smooth_noise(grid, seed + 23, 0.05)
    scuffs = np.maximum(smooth_noise(grid, seed + 24, 0.0012, stretch=14.0) - 2.0, 0.0)
    dust = np.maximum(smooth_noise(grid, seed + 25, 0.0010) - 2.6, 0.0)
    scratches = np.maximum(smooth_noise(grid, seed + 26, 0.0015, stretch=3.0) - 2.2, 0.0)
    chips = np.maximum(smooth_noise(grid, seed + 27, 0.0018) - 2.7, 0.0)
    column, row = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    place = apply_homography(grid.metres_from_pixel, np.dstack([column, row]))
    seam = np.exp(-(((place[..., 0]) / 0.0012) ** 2)).astype(np.float32)
    dark = 46 + wear * (5 * grain + 6 * roller + 8 * clouds + 60 * scuffs + 120 * dust)
    dark += wear * (45 * scratches - 30 * seam)
    light = 226 + wear * (3 * grain + 4 * roller + 3 * clouds - 50 * scuffs - 70 * scratches)
    light -= wear * (90 * chips + 40 * seam)
    return dark.astype(np.float32), light.astype(np.float32)


def _inside_board(grid: Grid) -> NDArray[np.float32]:
    """Return (h, w): how much of each pixel lies on the board, whose centre is the origin."""
    length, width = BOARD_METRES
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    return _filled(grid, [corners])


def _painted(grid: Grid) -> NDArray[np.float32]:
    """Return (h, w): how much of each pixel is white paint."""
    shapes = []
    for start, end in _LINES:
        low, high = np.minimum(start, end) - LINE_METRES / 2, np.maximum(start, end)
        shapes.append(_rectangle(low, high + LINE_METRES / 2))
    shapes += [_rectangle(np.array(low), np.array(low) + SQUARE_METRES) for low in _SQUARES]
    middle = np.array([BOARD_METRES[0] / 2, 0.0])
    return _filled(grid, [shape - middle for shape in shapes])


def _rectangle(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])


def _filled(grid: Grid, shapes: list[NDArray[np.float64]]) -> NDArray[np.float32]:
    """Return the share of each pixel that axis-parallel rectangles cover, exactly."""
    column, row = np.arange(grid.width), np.arange(grid.height)
    centres_x = grid.metres_from_pixel[0, 0] * column + grid.metres_from_pixel[0, 2]
    centres_y = grid.metres_from_pixel[1, 1] * row + grid.metres_from_pixel[1, 2]
    half = grid.metres_per_pixel / 2
    covered = np.zeros((grid.height, grid.width))
    for shape in shapes:
        low, high = shape.min(axis=0), shape.max(axis=0)
        across = _overlap(centres_x - half, centres_x + half, low[0], high[0])
        along = _overlap(centres_y - half, centres_y + half, low[1], high[1])
        np.maximum(covered, along[:, None] * across / grid.metres_per_pixel**2, out=covered)
    return covered.astype(np.float32)


def _overlap(
    start: NDArray[np.float64], end: NDArray[np.float64], low: float, high: float
) -> NDArray[np.float64]:
    return np.asarray(np.maximum(np.minimum(end, high) - np.maximum(start, low), 0.0))


def _tinted(gray: NDArray[np.float32], tint: tuple[float, float, float]) -> NDArray[np.uint8]:
    colour = gray[..., None] * np.array(tint, np.float32)
    return np.clip(np.round(colour), 0, 255).astype(np.uint8)


FLOORS: dict[str, Callable[[Grid, float, int], NDArray[np.uint8]]] = {
    "asphalt": _asphalt,
    "concrete": _concrete,
    "course": _course,
}
