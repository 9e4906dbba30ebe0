"""The choice among the frames of a video: the sharpest of each interval, one where it stands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.config import FrameSelection

Payload = TypeVar("Payload")

# Sharpness is compared on pictures of at most about this width: there the blur of motion still
# differs, and the noise does not count as detail.
_SHARPNESS_WIDTH = 960
# Frames that are not denser than this share of an interval are all taken.
_DENSE_SHARE = 0.9
# Standing is decided on pictures of at most about this width, in blocks of this side.
_STANDING_WIDTH, _BLOCK_PIXELS = 240, 16
# A block stands where it changes by less than this share of its own contrast, gray levels (root
# mean square): by a few pixels of the frame [guarded by tests/io/containers/test_video.py].
_STILL_SHARE, _STILL_GRAY = 0.2, 1.0
# Only detail of this contrast would show a motion; so many blocks must have it.
_DETAIL_GRAY, _MIN_DETAIL_SHARE = 4.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Candidate(Generic[Payload]):
    """A frame that may be chosen.

    Attributes
    ----------
    seconds : float
        From the first frame.
    luma : (H, W) uint8
    payload
        What the reader needs to return the picture.
    """

    seconds: float
    luma: UInt8Array
    payload: Payload


@dataclass(slots=True)
class Counts:
    """How many frames there are in the part that was chosen, and why some of them are left out.

    Attributes
    ----------
    all : int
    damaged : int
    standing : int
        Of a camera that has not moved since the frame before.
    thinned : bool
        Whether only the sharpest frame of each interval is taken.
    """

    all: int = 0
    damaged: int = 0
    standing: int = 0
    thinned: bool = False

    def note(self, name: str, taken: int) -> str:
        """Return the line that says which frames of a file were chosen."""
        parts = [f"{name}: {taken} of {self.all} frames taken"]
        if self.thinned:
            parts.append("the sharpest of each interval (--every)")
        if self.standing:
            parts.append(f"{self.standing} left out where the camera stands")
        if self.damaged:
            parts.append(f"{self.damaged} damaged")
        return ", ".join(parts)


def choose(
    candidates: Iterable[Candidate[Payload]],
    selection: FrameSelection,
    step_seconds: float,
    counts: Counts,
) -> Iterator[Candidate[Payload]]:
    """Yield the frames that a selection takes of all sound ones, in their order.

    Parameters
    ----------
    step_seconds : float
        Time between two frames, on average.
    counts : Counts
        Filled.
    """
    counts.thinned = step_seconds <= _DENSE_SHARE * selection.interval_seconds
    chosen = _within(candidates, selection, counts)
    if counts.thinned:
        chosen = sharpest(chosen, selection.interval_seconds, step_seconds)
    yield from moving(chosen, counts)


def _within(
    candidates: Iterable[Candidate[Payload]], selection: FrameSelection, counts: Counts
) -> Iterator[Candidate[Payload]]:
    """Yield the frames of the part that was selected."""
    begin, end = selection.from_seconds or 0.0, selection.to_seconds
    for candidate in candidates:
        if end is not None and candidate.seconds > end:
            return
        if candidate.seconds >= begin:
            counts.all += 1
            yield candidate


def sharpest(
    candidates: Iterable[Candidate[Payload]], interval_seconds: float, step_seconds: float
) -> Iterator[Candidate[Payload]]:
    """Yield the sharpest frame of each interval, the first of equals.

    Parameters
    ----------
    step_seconds : float
        Time between two frames, on average.
    """
    best: tuple[int, float, Candidate[Payload]] | None = None
    for candidate in candidates:
        # In the middle between two frames, so that rounded stamps do not change the interval.
        slot = math.floor((candidate.seconds + 0.5 * step_seconds) / interval_seconds)
        sharpness = _sharpness(candidate.luma)
        if best is not None and slot != best[0]:
            yield best[2]
            best = None
        if best is None or sharpness > best[1]:
            best = slot, sharpness, candidate
    if best is not None:
        yield best[2]


def moving(
    candidates: Iterable[Candidate[Payload]], counts: Counts
) -> Iterator[Candidate[Payload]]:
    """Yield the frames that differ from the one yielded before: of a standing camera, the first."""
    kept: Float32Array | None = None
    last: UInt8Array | None = None
    for candidate in candidates:
        fine = _fine(candidate.luma)
        if kept is not None and last is not None and kept.shape == fine.shape:
            same = np.array_equal(last, candidate.luma)
            if same or _is_standing(kept, fine):
                counts.standing += 1
                continue
        kept, last = fine, candidate.luma
        yield candidate


def _reduced(luma: UInt8Array, width: int) -> UInt8Array:
    """Return a picture reduced by a whole number to at most about a width."""
    factor = max(1, round(luma.shape[1] / width))
    size = max(1, luma.shape[1] // factor), max(1, luma.shape[0] // factor)
    return np.asarray(cv2.resize(luma, size, interpolation=cv2.INTER_AREA), np.uint8)


def _sharpness(luma: UInt8Array) -> float:
    """Return the mean square of the Laplacian."""
    laplacian = cv2.Laplacian(_reduced(luma, _SHARPNESS_WIDTH), cv2.CV_16S, ksize=3)
    return float(cv2.norm(laplacian, cv2.NORM_L2SQR) / laplacian.size)


def _fine(luma: UInt8Array) -> Float32Array:
    """Return a reduced picture without what is broader than a block, as changes of light are."""
    small = _reduced(luma, _STANDING_WIDTH).astype(np.float32)
    return np.asarray(small - cv2.blur(small, (_BLOCK_PIXELS, _BLOCK_PIXELS)), np.float32)


def _is_standing(before: Float32Array, after: Float32Array) -> bool:
    """Return whether the camera has not moved: no block changed, and most could show a motion."""
    contrast, change = _block_rms(before), _block_rms(after - before)
    still = change <= np.maximum(_STILL_GRAY, _STILL_SHARE * contrast)
    detailed = float(np.mean(contrast >= _DETAIL_GRAY))
    return bool(still.all()) and detailed >= _MIN_DETAIL_SHARE


def _block_rms(values: Float32Array) -> Float32Array:
    """Return the root mean square of each block."""
    size = (-(-values.shape[1] // _BLOCK_PIXELS), -(-values.shape[0] // _BLOCK_PIXELS))
    means = cv2.resize(values**2, size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.sqrt(np.atleast_2d(means)), np.float32)
