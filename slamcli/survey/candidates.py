"""Candidates: pairs of frames that may overlap, by sequence, by appearance, by predicted poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.geometry import apply_homography

# [All thresholds here: guarded by benchmarks/real_sets.py.]
NEIGHBOURS = 2
# Every frame's strongest so many candidates by appearance are matched, each with these votes.
_MAX_A_FRAME, _MIN_VOTES = 8, 5
# So many pairs are compared by their largest points; of longer sequences every k-th frame.
_MAX_COMPARED = 20_000
# A predicted overlap of this share of a frame is worth matching.
_MIN_SHARE, _PROBES = 0.15, 8
NumberPair = tuple[int, int]


def by_sequence(frames: int) -> list[NumberPair]:
    """Return every frame with the next ones."""
    steps = range(1, NEIGHBOURS + 1)
    return [(a, a + step) for a in range(frames) for step in steps if a + step < frames]


def compared(frames: int) -> list[NumberPair]:
    """Return the pairs that are compared by appearance."""
    step = 1
    while (frames // step) ** 2 // 2 > _MAX_COMPARED:
        step += 1
    some = range(0, frames, step)
    return [(a, b) for a in some for b in some if a < b]


def by_appearance(pairs: Sequence[NumberPair], votes: Sequence[int]) -> list[NumberPair]:
    """Return, of pairs with their votes, those that are among the strongest of either frame."""
    of_frame: dict[int, list[tuple[int, NumberPair]]] = {}
    for pair, count in zip(pairs, votes, strict=True):
        if count >= _MIN_VOTES:
            for frame in pair:
                of_frame.setdefault(frame, []).append((-count, pair))
    chosen = {pair for found in of_frame.values() for _, pair in sorted(found)[:_MAX_A_FRAME]}
    return sorted(chosen)


def by_overlap(
    image_from_map: Float64Array, frames: Sequence[int], sizes: Sequence[tuple[int, int]]
) -> list[NumberPair]:
    """Return the pairs of one map whose poses predict that they overlap.

    Parameters
    ----------
    image_from_map : (N, 3, 3) float64
        To pixels from the pictures' middles.
    frames : sequence of int
    sizes : sequence of (int, int)
        Of their pictures.
    """
    share = (np.arange(_PROBES) + 0.5) / _PROBES - 0.5
    across, down = np.meshgrid(share, share)
    unit = np.column_stack([across.ravel(), down.ravel()])
    map_from_image = np.linalg.inv(image_from_map)
    probes = np.array([_on_floor(m, unit * s) for m, s in zip(map_from_image, sizes, strict=True)])
    found = []
    for number, homography in enumerate(image_from_map):
        inside = _inside(homography, probes, sizes[number]).mean(axis=1)
        found += [(number, int(other)) for other in np.flatnonzero(inside >= _MIN_SHARE)]
    return sorted({ordered(frames[a], frames[b]) for a, b in found if a != b})


def ordered(a: int, b: int) -> NumberPair:
    """Return two numbers, the smaller first."""
    return (a, b) if a < b else (b, a)


def untried(pairs: Iterable[NumberPair], tried: set[NumberPair]) -> list[NumberPair]:
    """Return the pairs that have not been tried, in order, each once."""
    return sorted(set(pairs) - tried)


def _on_floor(map_from_image: Float64Array, pixels: Float64Array) -> Float64Array:
    """Return (N, 2) where pixels show the floor; nan above the horizon."""
    floor = apply_homography(map_from_image, pixels)
    floor[~(pixels @ map_from_image[2, :2] + map_from_image[2, 2] > 0.0)] = np.nan
    return floor


def _inside(homography: Float64Array, probes: Float64Array, size: tuple[int, int]) -> BoolArray:
    depth = probes @ homography[2, :2] + homography[2, 2]
    pixels = apply_homography(homography, probes)
    inside: BoolArray = (depth > 0) & np.all(np.abs(pixels) < np.array(size) / 2, axis=-1)
    return inside
