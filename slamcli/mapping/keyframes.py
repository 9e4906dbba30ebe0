"""Keyframes: compressed storage, a cache of decoded ones, and the database that finds them.

The pixels of the view that is compared are stored as a JPEG whose error is below a camera's noise;
the pyramid is computed from them: a twentieth of the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.deferred import Deferred
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Grid
from slamcli.core.records import Features, Keyframe, PreparedFrame, Pyramids, View
from slamcli.stages import dense
from slamcli.stages.place_index import PlaceCandidate, PlaceIndex, PlaceMatches

# Correlations of a decoded keyframe differ by less than 0.02 from those of the frame.
# [guarded by tests/mapping/test_loop_closure.py]
_JPEG_QUALITY = 90
# A decoded keyframe takes some megabytes. Most cameras' views have one mask.
_MAX_DECODED, _MAX_MASKS = 16, 4
# At half the resolution it takes a quarter of that.
_MAX_HALVED = 64
# Points of a level that its frames are then aligned with [guarded by benchmarks/locate.py].
_MAX_HALVED_POINTS = 4000
# A motion is refined on this many levels at least.
_MIN_LEVELS = 2


def encode_keyframe(prepared: PreparedFrame) -> Keyframe:
    """Return a prepared frame, which has features and levels, compressed."""
    assert prepared.features is not None
    features, first = prepared.features, prepared.levels[0]
    # OpenCV's SIFT descriptors are whole numbers, a quarter the size as bytes.
    whole = np.clip(features.descriptors, 0, 255).astype(np.uint8)
    if np.array_equal(whole, features.descriptors):
        features = replace(features, descriptors=whole)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, image = cv2.imencode(".jpg", first.image, quality)
    return Keyframe(
        prepared.index,
        prepared.name,
        prepared.stamp,
        features,
        np.asarray(image).tobytes(),
        _encoded_mask(first.mask.tobytes(), first.mask.shape),
    )


@lru_cache(maxsize=_MAX_MASKS)
def _encoded_mask(mask: bytes, shape: tuple[int, ...]) -> bytes:
    """Return a mask's pixels as PNG."""
    _, encoded = cv2.imencode(".png", np.frombuffer(mask, np.uint8).reshape(shape))
    return np.asarray(encoded).tobytes()


class KeyframeCache:
    """Least-recently-used cache of decoded keyframes; threads may share it.

    A copy or a pickle of it is empty: decoded keyframes are much larger than compressed ones.

    Parameters
    ----------
    grid : Grid
        Of the views that are compared.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        masks = lru_cache(maxsize=_MAX_MASKS)(partial(_level_masks, grid))
        self._decoded = lru_cache(maxsize=_MAX_DECODED)(partial(_decode_keyframe, grid, masks))
        self._halved = lru_cache(maxsize=_MAX_HALVED)(
            partial(_decode_keyframe, grid, masks, halved=True)
        )

    def __reduce__(self) -> tuple[type[KeyframeCache], tuple[Grid]]:
        return KeyframeCache, (self.grid,)

    def decode(self, keyframe: Keyframe) -> PreparedFrame:
        """Return a keyframe with its pyramid, but without its view.

        Raises
        ------
        FrameError
            When its images are not of the grid's views.
        """
        return self._decoded(keyframe)

    def decode_halved(self, keyframe: Keyframe) -> PreparedFrame:
        """Return a keyframe as `decode` does, at half the resolution."""
        return self._halved(keyframe)


class KeyframeDatabase:
    """All keyframes of a map, in the order of insertion, found again by their descriptors.

    Parameters
    ----------
    grid : Grid
        Of the views that are compared.
    seed : int
        Of the place index.
    """

    def __init__(self, grid: Grid, seed: int) -> None:
        self._cache = KeyframeCache(grid)
        self._places = PlaceIndex(seed)
        self._keyframes: dict[int, Keyframe] = {}
        self._number: dict[int, int] = {}
        self.order: list[int] = []

    def __contains__(self, index: int) -> bool:
        return index in self._number

    @property
    def keyframes(self) -> list[Keyframe]:
        """All of them, in the order of insertion."""
        return list(self._keyframes.values())

    def add(self, keyframe: Keyframe) -> None:
        """Insert a keyframe."""
        self._number[keyframe.index] = len(self.order)
        self.order.append(keyframe.index)
        self._keyframes[keyframe.index] = keyframe
        self._places.add(keyframe.index, keyframe.features)

    def query(
        self, features: Features, excluded: frozenset[int] = frozenset()
    ) -> list[PlaceCandidate]:
        """Return the keyframes that look like a frame, most votes first."""
        return self._places.query(features, excluded)

    def match(self, features: Features) -> PlaceMatches:
        """Return the matches of a frame with the keyframes that have most, not yet voted on."""
        return self._places.match(features)

    def decode(self, index: int) -> PreparedFrame:
        """Return a keyframe ready for registration."""
        return self._cache.decode(self._keyframes[index])

    def decode_halved(self, index: int) -> PreparedFrame:
        """Return a keyframe ready for registration at half the resolution."""
        return self._cache.decode_halved(self._keyframes[index])

    def latest(self, count: int) -> frozenset[int]:
        """Return the latest keyframes."""
        return frozenset(self.order[-count:])

    def before(self, index: int) -> int | None:
        """Return the keyframe that was inserted before another; None for the first."""
        number = self._number[index]
        return self.order[number - 1] if number else None

    def around(self, indices: Iterable[int], steps: int) -> set[int]:
        """Return keyframes and those that were inserted up to so many steps before or after."""
        numbers = {
            self._number[index] + step for index in indices for step in range(-steps, steps + 1)
        }
        return {self.order[number] for number in numbers if 0 <= number < len(self.order)}

    def is_expected(self, index: int) -> bool:
        """Return whether a frame lies as far after the latest keyframe as that after another.

        Or twice as far and so on: of a steady drive these become keyframes.
        """
        latest = self.order[-2:]
        spacing = latest[-1] - latest[0] if latest else 0
        return spacing > 0 and index > latest[-1] and (index - latest[-1]) % spacing == 0

    def steps_between(self, a: int, b: int) -> int:
        """Return how many keyframes after a the keyframe b was inserted."""
        return self._number[b] - self._number[a]


def can_be_halved(level_masks: Sequence[dense.LevelMask]) -> bool:
    """Return whether a view of these level masks has levels enough at half its resolution."""
    return len(level_masks) > _MIN_LEVELS


def _decode_keyframe(
    grid: Grid,
    masks_of: Callable[[bytes], Sequence[dense.LevelMask]],
    keyframe: Keyframe,
    *,
    halved: bool = False,
) -> PreparedFrame:
    image, level_masks = _decode_image(keyframe.image, grid), masks_of(keyframe.mask)
    if image is None or not level_masks:
        raise FrameError(f"keyframe {keyframe.name}: its images cannot be used")
    view = View(grid, image, level_masks[0].mask)
    if halved:
        coarser = level_masks[1:] if can_be_halved(level_masks) else None
        levels = dense.make_levels(dense.halved(view), coarser, _MAX_HALVED_POINTS)
    else:
        levels = dense.make_levels(view, level_masks)
    features = keyframe.features
    if features.norm == "l2":
        features = replace(features, descriptors=features.descriptors.astype(np.float32))
    return PreparedFrame(
        keyframe.index,
        keyframe.name,
        keyframe.stamp,
        None,
        Deferred.of(features),
        pyramids=Deferred.of(Pyramids(levels)),
        periodicity=Deferred(partial(dense.find_periods, levels)),
        tracked=None
        if halved or len(levels) < _MIN_LEVELS
        else Deferred.of((levels[0], levels[1])),
    )


def _level_masks(grid: Grid, encoded: bytes) -> tuple[dense.LevelMask, ...]:
    """Return the level masks of a keyframe's mask; none when it cannot be used."""
    mask = _decode_image(encoded, grid)
    return () if mask is None else dense.make_level_masks(mask)


def _decode_image(encoded: bytes, grid: Grid) -> UInt8Array | None:
    """Return the gray image of a JPEG or PNG; None when its size is not the grid's."""
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    shape = grid.height, grid.width
    return None if picture is None or picture.shape != shape else np.asarray(picture, np.uint8)
