"""Learned features: ALIKED, DISK or XFeat, from the user's weights."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array
from slamcli.core.config import FeatureOptions
from slamcli.core.errors import InputError
from slamcli.core.geometry import apply_homography
from slamcli.core.records import Keypoints
from slamcli.stages.features.selection import DetectorInput, choose, pixel_from_level

# Of the network's own picture: ALIKED places its points between the pixels, the others upon them.
_SIGMA_PIXELS = {"aliked": 0.25, "disk": 0.5, "xfeat": 0.5}
# About the size of the patch that the networks see of a point, for drawings.
_SEEN_PIXELS = 8.0


def detect_learned(picture: DetectorInput, options: FeatureOptions) -> Keypoints:
    """Find the points of a picture with the options' network.

    Raises
    ------
    InputError
        When the options have no network.
    FrameError
        When the network fails on the picture.
    """
    network = options.network
    if network is None:
        raise InputError(f"{options.method.upper()} features need their network's weights")
    shown, full_shape = _fitted(picture.gray, network.size)
    found = network.find(np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), np.uint8))
    pixels = apply_homography(pixel_from_level(full_shape, shown.shape), found.pixels)
    scale = full_shape[0] / shown.shape[0]
    kept = np.flatnonzero(_allowed(picture.allowed, pixels))
    chosen = kept[choose(picture, pixels[kept], found.scores[kept], scale, options)]
    scales = np.full(len(chosen), scale, np.float32)
    return Keypoints(
        pixels=pixels[chosen],
        sizes=np.float32(_SEEN_PIXELS) * scales,
        angles=np.full(len(chosen), np.nan, np.float32),
        responses=found.scores[chosen],
        octaves=np.zeros(len(chosen), np.int32),
        scales=scales,
        sigmas=np.float32(_SIGMA_PIXELS[options.method]) * scales,
        descriptors=found.descriptors[chosen],
        norm="l2",
    )


def _fitted(gray: UInt8Array, size: tuple[int, int]) -> tuple[UInt8Array, tuple[int, int]]:
    """Return the picture at a network's size, and the (rows, columns) that it was padded to.

    Black is added at the right or below, as squeezing one side more than the other would change
    what a turned floor looks like.
    """
    rows, columns = gray.shape
    scale = max(columns / size[0], rows / size[1])
    full_rows, full_columns = math.ceil(scale * size[1]), math.ceil(scale * size[0])
    padded = cv2.copyMakeBorder(
        gray, 0, full_rows - rows, 0, full_columns - columns, cv2.BORDER_CONSTANT, value=0
    )
    method = cv2.INTER_AREA if scale > 1.0 else cv2.INTER_LINEAR
    shown = cv2.resize(padded, size, interpolation=method)
    return np.asarray(shown, np.uint8), (full_rows, full_columns)


def _allowed(allowed: UInt8Array, pixels: Float64Array) -> BoolArray:
    """Return which (N, 2) places lie where a point may."""
    column, row = np.rint(pixels).astype(np.int64).T
    rows, columns = allowed.shape
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    inside[inside] = allowed[row[inside], column[inside]] > 0
    return np.asarray(inside)
