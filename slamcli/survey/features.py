"""Features of one frame of a survey: SIFT points, and the small picture that verifies a pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, IntpArray, UInt8Array
from slamcli.core.camera.lens import image_centre

# Points are detected in a picture of at most this many pixels: SIFT doubles it first, so that its
# finest level is about the camera's own. [All thresholds here: guarded by benchmarks/real_sets.py.]
_MAX_PIXELS = 700_000
_MAX_POINTS, _MAX_COARSE_POINTS = 2500, 300
_CONTRAST_THRESHOLD = 0.006
# The strongest points of each cell of such a grid are kept, so that no bush uses them all up.
_CELLS = 10
_THUMBNAIL_SIDE_PIXELS = 200
# Brightness and contrast of the small picture are normalised within this sigma.
_LOCAL_SIGMA_PIXELS, _MIN_DEVIATION_GRAY = 4.0, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class SurveyFeatures:
    """What pairs of frames are found, matched and verified by.

    Attributes
    ----------
    size : (int, int)
        Width and height of the picture in pixels.
    pixels : (N, 2) float64
        Column and row from the picture's middle.
    descriptors : (N, 128) float32
        RootSIFT, unit vectors (Arandjelovic and Zisserman, CVPR 2012).
    coarse : (M,) int
        The points of largest size, by which overlapping frames are found.
    thumbnail : (h, w) float32
        The picture reduced, its local brightness and contrast normalised; 0 where not known.
    """

    size: tuple[int, int]
    pixels: Float64Array
    descriptors: Float32Array
    coarse: IntpArray
    thumbnail: Float32Array

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def thumbnail_from_image(self) -> Float64Array:
        """(3, 3): pixels from the picture's middle to those of the thumbnail."""
        height, width = self.thumbnail.shape
        column, row = image_centre((width, height))
        return np.array(
            [
                [width / self.size[0], 0.0, column],
                [0.0, height / self.size[1], row],
                [0.0, 0.0, 1.0],
            ]
        )


def survey_features(gray: UInt8Array, mask: UInt8Array | None = None) -> SurveyFeatures:
    """Return the features of a picture.

    Parameters
    ----------
    gray : (H, W) uint8
    mask : (H, W) uint8 or None
        0 where nothing was seen.
    """
    height, width = gray.shape
    small, allowed = reduced(gray, mask)
    sift = cv2.SIFT.create(
        nfeatures=4 * _MAX_POINTS,
        contrastThreshold=_CONTRAST_THRESHOLD,
        enable_precise_upscale=True,
    )
    points = sift.detect(small, allowed)
    described, raw = sift.compute(small, [points[number] for number in _spread(points, small)])
    descriptors = np.asarray(raw if described else [], np.float32).reshape(-1, 128)
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-6))
    found = np.asarray(cv2.KeyPoint.convert(described), np.float64).reshape(-1, 2)
    factor = np.array([width / small.shape[1], height / small.shape[0]])
    sizes = np.array([point.size for point in described])
    return SurveyFeatures(
        (width, height),
        (found + 0.5) * factor - 0.5 - image_centre((width, height)),
        np.sqrt(descriptors / sums),
        np.argsort(-sizes, kind="stable")[:_MAX_COARSE_POINTS],
        local_detail(gray, mask, _THUMBNAIL_SIDE_PIXELS),
    )


def reduced(gray: UInt8Array, mask: UInt8Array | None) -> tuple[UInt8Array, UInt8Array | None]:
    """Return a picture and its mask as points are detected in them, of not too many pixels."""
    height, width = gray.shape
    scale = (_MAX_PIXELS / (width * height)) ** 0.5
    if scale >= 1.0:
        return gray, mask
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)
    if mask is None:
        return small, None
    return small, np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _spread(points: Sequence[cv2.KeyPoint], picture: UInt8Array) -> list[int]:
    """Return the numbers of the points to keep: the strongest of each cell, by turns."""
    if len(points) <= _MAX_POINTS:
        return list(range(len(points)))
    places = np.array([point.pt for point in points])
    responses = np.array([point.response for point in points])
    cells = np.floor(places * _CELLS / np.array(picture.shape[::-1])).astype(np.int64)
    rank = rank_in_group(cells[:, 1] * _CELLS + cells[:, 0], -responses)
    kept: list[int] = np.sort(np.lexsort((-responses, rank))[:_MAX_POINTS]).tolist()
    return kept


def rank_in_group(group: IntpArray, value: Float64Array | None = None) -> IntpArray:
    """Return (N,) the place of each item in its group, by rising value or as they come."""
    order = np.lexsort((group,) if value is None else (value, group))
    _, counts = np.unique(group[order], return_counts=True)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    rank = np.empty(len(group), np.intp)
    rank[order] = np.arange(len(group)) - first
    return rank


def local_detail(gray: UInt8Array, mask: UInt8Array | None, side_pixels: int) -> Float32Array:
    """Return a picture reduced to a longer side, its local brightness and contrast normalised."""
    height, width = gray.shape
    scale = min(1.0, side_pixels / max(width, height))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32)
    known = np.ones_like(small)
    if mask is not None:
        opaque = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA))
        known = (opaque > 254).astype(np.float32)

    def local(values: Float32Array) -> Float32Array:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), _LOCAL_SIGMA_PIXELS), np.float32)

    seen = local(known) + np.float32(1e-6)
    detail = (small - local(small * known) / seen) * known
    deviation = np.sqrt(local(detail * detail) / seen)
    return np.asarray(detail / (deviation + np.float32(_MIN_DEVIATION_GRAY)), np.float32)
