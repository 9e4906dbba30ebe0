"""A static pattern of light, found as the frames' median before they are registered.

Where a lamp's pattern outshines a plain floor that moves under it, the pattern is what registers:
no frame seems to move. It is taken out only where consecutive frames then fit better than before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile, read_frame, read_reduced_gray
from slamcli.io.images.light import StaticLight
from slamcli.run.session.session import Session
from slamcli.survey import survey_features
from slamcli.survey.pairs import find_pair

# [All thresholds here: guarded by tests/survey/test_static_light.py.]
_MIN_FRAMES, _MAX_FRAMES, _PROBES = 6, 24, 3
# The pattern's contrast without what is broader than this share of the picture, as vignetting is,
# and the correlation of those of every other frame.
_BROAD_SHARE, _MIN_CONTRAST, _MIN_CORRELATION = 1 / 6, 0.03, 0.7
_DARKEST_GRAY, _MAX_GAIN = 2.0, 3.0
# Frames that move by less than this share of the picture may have been held by the pattern.
_STILL_SHARE, _BETTER_FACTOR = 0.01, 1.3


def without_static_light(files: Sequence[FrameFile], session: Session) -> list[FrameFile]:
    """Return the files, to be read without their static pattern of light where they have one."""
    light = _find(files, session)
    if light is None:
        return list(files)
    evened = [replace(file, light=light) for file in files]
    if _registered(evened, session) <= _BETTER_FACTOR * _registered(files, session):
        return list(files)
    return evened


def _find(files: Sequence[FrameFile], session: Session) -> StaticLight | None:
    """Return the light that the frames have in common; None without a plain one."""
    if len(files) < _MIN_FRAMES:
        return None
    some = np.unique(np.linspace(0, len(files) - 1, _MAX_FRAMES).round().astype(int)).tolist()
    read = [one for one in session.ordered(_gray, [files[n] for n in some]) if one is not None]
    if not read:
        return None
    logarithms = [np.log(one + _DARKEST_GRAY) for one in read if one.shape == read[0].shape]
    if len(logarithms) < _MIN_FRAMES:
        return None
    stack = np.stack([one - np.median(one) for one in logarithms]).astype(np.float32)
    halves = [_fine(np.median(stack[first::2], axis=0)) for first in (0, 1)]
    pattern = np.median(stack, axis=0).astype(np.float32)
    correlation = float(np.corrcoef(halves[0].ravel(), halves[1].ravel())[0, 1])
    if _fine(pattern).std() < _MIN_CONTRAST or not correlation > _MIN_CORRELATION:
        return None
    limit = math.log(_MAX_GAIN)
    return StaticLight(np.exp(-np.clip(pattern, -limit, limit)).astype(np.float32))


def _gray(file: FrameFile) -> UInt8Array | None:
    try:
        return read_reduced_gray(file)
    except FrameError:
        return None


def _fine(pattern: Float32Array) -> Float32Array:
    """Return a pattern without what is broad."""
    values = pattern.astype(np.float32)
    sigma = _BROAD_SHARE * max(values.shape)
    return np.asarray(values - cv2.GaussianBlur(values, (0, 0), sigma), np.float32)


def _registered(files: Sequence[FrameFile], session: Session) -> int:
    """Return how many points of some consecutive frames agree on a motion that is none of 0."""
    starts = np.unique(np.linspace(0, len(files) - 2, _PROBES).round().astype(int)).tolist()
    pairs = [(files[number], files[number + 1]) for number in starts]
    return sum(session.ordered(_moved_points, pairs))


def _moved_points(pair: tuple[FrameFile, FrameFile]) -> int:
    try:
        frames = [read_frame(file, gray=True) for file in pair]
    except FrameError:
        return 0
    first, second = (survey_features(frame.image, frame.mask) for frame in frames)
    found = find_pair(0, 1, first, second)
    if found.reason:
        return 0
    moved = np.median(np.linalg.norm(found.pixels_a - found.pixels_b, axis=1))
    return found.inliers if moved > _STILL_SHARE * max(first.size) else 0
