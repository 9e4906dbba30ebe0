"""Frames that are seen from a slant: features of views of them that are tilted by computation.

SIFT's points are found again under a turn and another scale, but hardly where two views differ in
tilt by more than 40 degrees. Of a frame that fits no other, views are computed as a camera far away
would have them from several sides, and the points of each are matched (affine SIFT: Morel and Yu,
SIAM Journal on Imaging Sciences 2, 2009, with the tilts up to 60 degrees).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.lens import image_centre
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey.features import SurveyFeatures, reduced, survey_features
from slamcli.survey.pairs import Pair, coarse_votes, find_pair

# Ratios by which a view is compressed, and the step of the directions, degrees times the ratio; and
# the blur, pixels times sqrt(ratio^2 - 1), of what is compressed (Morel and Yu, section 3.3: 0.8,
# less what the picture is blurred by itself).
_RATIOS, _STEP_DEGREES, _BLUR_PIXELS = (math.sqrt(2.0), 2.0), 72.0, 0.6
# The views beside the frame itself.
VIEWS = sum(math.ceil(180.0 * ratio / _STEP_DEGREES) for ratio in _RATIOS)
# What lies this near to a view's edge is not described: it would be the edge that is.
_BORDER_PIXELS = 7
# So many pairs of a view and another frame, those with most votes, are matched.
_MAX_TRIED = 24


def slanted_features(gray: UInt8Array, mask: UInt8Array | None = None) -> list[SurveyFeatures]:
    """Return the features of each tilted view of a picture, in pixels of the picture itself.

    Parameters
    ----------
    gray : (H, W) uint8
    mask : (H, W) uint8 or None
        0 where nothing was seen.
    """
    own = survey_features(gray, mask)
    small, known = reduced(gray, mask)
    known = np.full_like(small, 255) if known is None else known
    scale = np.array(own.size) / small.shape[::-1]
    found = []
    for ratio in _RATIOS:
        for degrees in np.arange(0.0, 180.0, _STEP_DEGREES / ratio).tolist():
            picture, seen, view_from_small = _view(small, known, ratio, degrees)
            features = survey_features(picture, seen)
            pixels = features.pixels + image_centre(features.size)
            there = apply_homography(invert(view_from_small), pixels)
            there = (there + 0.5) * scale - 0.5 - image_centre(own.size)
            found.append(
                replace(own, pixels=there, descriptors=features.descriptors, coarse=features.coarse)
            )
    return found


def slanted_pairs(
    frame: int, views: Sequence[SurveyFeatures], features: Sequence[SurveyFeatures]
) -> list[Pair]:
    """Return the pairs of a frame, by its tilted views, with others, each with its best view."""
    votes = [
        (-coarse_votes(view, other), number, way)
        for number, other in enumerate(features)
        for way, view in enumerate(views)
        if number != frame
    ]
    best: dict[int, Pair] = {}
    for _, number, way in sorted(votes)[:_MAX_TRIED]:
        described = {frame: views[way], number: features[number]}
        a, b = sorted(described)
        pair = find_pair(a, b, described[a], described[b])
        if not pair.reason and (number not in best or pair.inliers > best[number].inliers):
            best[number] = pair
    return [best[number] for number in sorted(best)]


def _view(
    gray: UInt8Array, mask: UInt8Array, ratio: float, degrees: float
) -> tuple[UInt8Array, UInt8Array, Float64Array]:
    """Return a view of a picture, its mask, and (3, 3) its pixels from those of the picture."""
    height, width = gray.shape
    turn = math.radians(degrees)
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ rotation.T
    low, extent = corners.min(axis=0), np.ptp(corners, axis=0)
    turned = np.column_stack([rotation, -low])
    size = math.ceil(extent[0]), math.ceil(extent[1])
    border = cv2.BORDER_REPLICATE
    picture = cv2.warpAffine(gray, turned, size, borderMode=border)
    sigma = _BLUR_PIXELS * math.sqrt(ratio**2 - 1.0)
    picture = cv2.GaussianBlur(picture, (0, 0), sigmaX=sigma, sigmaY=0.01)
    seen = cv2.erode(cv2.warpAffine(mask, turned, size), np.ones((_BORDER_PIXELS,) * 2, np.uint8))
    narrow = max(1, round(size[0] / ratio)), size[1]
    compress = narrow[0] / size[0]
    view_from_small = np.array([[compress, 0.0, (compress - 1.0) / 2], [0, 1, 0], [0, 0, 1.0]])
    view_from_small = view_from_small @ np.vstack([turned, [0.0, 0.0, 1.0]])
    return (
        np.asarray(cv2.resize(picture, narrow, interpolation=cv2.INTER_LINEAR), np.uint8),
        np.asarray(cv2.resize(seen, narrow, interpolation=cv2.INTER_NEAREST), np.uint8),
        view_from_small,
    )
