"""Feature detectors: ORB and SIFT, spread over the picture and placed to a fraction of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.config import FeatureMethod, FeatureOptions
from slamcli.core.geometry import apply_homography
from slamcli.core.records import DescriptorNorm, Keypoints
from slamcli.stages.features import subpixel
from slamcli.stages.features.learned import detect_learned
from slamcli.stages.features.selection import DetectorInput, choose, pixel_from_level

# Spreading picks among this many times the points wanted: a painted line must not use them all
# up. ORB finds them at little extra cost [guarded by benchmarks/robustness.py].
_ORB_SURPLUS = 12
# SIFT describes every point at once, which costs; its points crowd less.
_SIFT_SURPLUS = 4
# One sigma in pixels of the level a point was found on, by the residuals of true matches on
# asphalt-like noise [guarded by benchmarks/accuracy.py].
_REFINED_SIGMA_PIXELS = 0.25
_CORNER_SIGMA_PIXELS = 0.5
_SIFT_SIGMA_PIXELS = 0.2
_ORB_DESCRIPTOR_BYTES = 32
_SIFT_DIMENSIONS = 128


def _detect_orb(picture: DetectorInput, options: FeatureOptions) -> Keypoints:
    levels = _usable_levels(picture.gray, options)
    orb = _orb(options, levels, options.fast_threshold)
    found = orb.detect(picture.gray, picture.allowed)
    if len(found) < options.count and options.min_fast_threshold < options.fast_threshold:
        orb = _orb(options, levels, options.min_fast_threshold)
        found = orb.detect(picture.gray, picture.allowed)
    scale_of = np.array([_orb_scale(options, octave) for octave in range(levels)])
    scales = scale_of[np.array([point.octave for point in found], np.int64)]
    chosen = [found[index] for index in _choose(picture, found, scales, options)]
    if options.upright:
        chosen = _upright(chosen)
    described, descriptors = orb.compute(picture.gray, chosen)
    octaves = [point.octave for point in described]
    corners = _keypoints(
        described,
        np.asarray(descriptors if described else [], np.uint8).reshape(-1, _ORB_DESCRIPTOR_BYTES),
        octaves,
        scale_of[octaves],
        "hamming" if options.wta_k == 2 else "hamming2",
    )
    return _unturned(_place_on_levels(corners, picture.gray, options), options)


def _usable_levels(gray: UInt8Array, options: FeatureOptions) -> int:
    """Return how many levels are larger than the border that is left out of each.

    Smaller ones have no point, and OpenCV fails when one has no pixel left.
    """
    side = min(gray.shape)
    levels = options.first_level + 1
    while levels < options.levels and (
        side / _orb_scale(options, levels) > 2 * options.edge_threshold
    ):
        levels += 1
    return levels


def _orb(options: FeatureOptions, levels: int, fast_threshold: int) -> cv2.ORB:
    return cv2.ORB.create(
        nfeatures=options.count * (_ORB_SURPLUS if options.spread else 1),
        scaleFactor=options.scale_factor,
        nlevels=levels,
        edgeThreshold=options.edge_threshold,
        firstLevel=options.first_level,
        WTA_K=options.wta_k,
        scoreType=cv2.ORB_HARRIS_SCORE,
        patchSize=options.patch_size,
        fastThreshold=fast_threshold,
    )


def _orb_scale(options: FeatureOptions, octave: int) -> float:
    """Return how many pixels of the picture one pixel of a level spans."""
    return float(options.scale_factor ** (octave - options.first_level))


def _place_on_levels(keypoints: Keypoints, gray: UInt8Array, options: FeatureOptions) -> Keypoints:
    """Correct where OpenCV puts ORB's points, and refine them if the options say so.

    OpenCV multiplies a level's whole pixels by the level's scale. That leaves out that the centre
    of a coarse pixel lies half a coarse pixel from its corner, and that a level has a whole number
    of pixels, so that its true scale differs by up to half a pixel at the far border.
    """
    corners = np.rint(keypoints.pixels / keypoints.scales[:, None]).astype(np.int64)
    octaves = range(int(keypoints.octaves.max(initial=-1)) + 1)
    places, found = corners.astype(np.float64), np.zeros(len(corners), np.bool_)
    if options.refine:
        images: list[UInt8Array] = []
        for octave in octaves:
            # OpenCV builds each level from the one before, enlarged ones from the picture itself.
            source = gray if octave <= options.first_level else images[-1]
            images.append(_shrink(source, _level_size(gray, options, octave)))
        places, found = subpixel.refine(images, keypoints.octaves, corners)
    sigma_pixels = np.where(found, _REFINED_SIGMA_PIXELS, _CORNER_SIGMA_PIXELS)
    pixels = np.empty_like(keypoints.pixels)
    for octave in octaves:
        here, shape = keypoints.octaves == octave, _level_size(gray, options, octave)[::-1]
        pixels[here] = apply_homography(pixel_from_level(gray.shape, shape), places[here])
    return replace(
        keypoints, pixels=pixels, sigmas=(sigma_pixels * keypoints.scales).astype(np.float32)
    )


def _level_size(gray: UInt8Array, options: FeatureOptions, octave: int) -> tuple[int, int]:
    """Return the width and height of one of OpenCV's levels."""
    scale = _orb_scale(options, octave)
    return round(gray.shape[1] / scale), round(gray.shape[0] / scale)


def _shrink(source: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    if size == source.shape[::-1]:
        return source
    resized = cv2.resize(source, size, interpolation=cv2.INTER_LINEAR_EXACT)
    return np.asarray(resized, dtype=np.uint8)


def _detect_sift(picture: DetectorInput, options: FeatureOptions) -> Keypoints:
    sift = cv2.SIFT.create(
        nfeatures=options.count * (_SIFT_SURPLUS if options.spread else 1),
        contrastThreshold=options.contrast_threshold,
        # Without it, doubling the picture shifts every point by a quarter of a pixel.
        enable_precise_upscale=True,
    )
    described: Sequence[cv2.KeyPoint]
    if options.upright:
        upright = _upright(sift.detect(picture.gray, picture.allowed))
        chosen = _choose(picture, upright, _sift_scales(upright), options)
        described, computed = sift.compute(picture.gray, [upright[index] for index in chosen])
        descriptors = np.asarray(computed if described else [], np.float32)
    else:
        # One call for both: describing the surplus too costs less than a second scale space.
        found, computed = sift.detectAndCompute(picture.gray, picture.allowed)
        chosen = _choose(picture, found, _sift_scales(found), options)
        described = [found[index] for index in chosen]
        descriptors = np.asarray(computed if found else [], np.float32)
        descriptors = descriptors.reshape(-1, _SIFT_DIMENSIONS)[chosen]
    keypoints = _keypoints(
        described,
        descriptors.reshape(-1, _SIFT_DIMENSIONS),
        [_sift_octave(point) for point in described],
        _sift_scales(described),
        "l2",
    )
    return _unturned(replace(keypoints, sigmas=_SIFT_SIGMA_PIXELS * keypoints.scales), options)


def _sift_scales(points: Sequence[cv2.KeyPoint]) -> Float64Array:
    """Return how many pixels of the picture one pixel of each point's octave spans."""
    return np.array([2.0 ** _sift_octave(point) for point in points])


def _sift_octave(point: cv2.KeyPoint) -> int:
    """Return the octave, -1 for the doubled picture, from the byte that OpenCV packs it into."""
    octave = point.octave & 255
    return octave - 256 if octave > 127 else octave


def _choose(
    picture: DetectorInput,
    found: Sequence[cv2.KeyPoint],
    scales: Float64Array,
    options: FeatureOptions,
) -> list[int]:
    """Return which of OpenCV's points to keep."""
    pixels = np.asarray(cv2.KeyPoint.convert(found), np.float64).reshape(-1, 2)
    responses = np.array([point.response for point in found], np.float32)
    kept: list[int] = choose(picture, pixels, responses, scales, options).tolist()
    return kept


def _unturned(keypoints: Keypoints, options: FeatureOptions) -> Keypoints:
    """Return keypoints without angles where the options leave them out."""
    if not options.upright:
        return keypoints
    return replace(keypoints, angles=np.full_like(keypoints.angles, np.nan))


def _upright(points: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
    """Return points whose descriptors will not turn with the texture, each place and size once.

    SIFT has a point more for each further direction that its surroundings may be seen to have.
    """
    first: dict[tuple[float, float, float], cv2.KeyPoint] = {}
    for point in points:
        x, y = point.pt
        turned = cv2.KeyPoint(x, y, point.size, 0.0, point.response, point.octave, point.class_id)
        first.setdefault((x, y, point.size), turned)
    return list(first.values())


def _keypoints(
    points: Sequence[cv2.KeyPoint],
    descriptors: UInt8Array | Float32Array,
    octaves: Sequence[int],
    scales: Sequence[float] | Float64Array,
    norm: DescriptorNorm,
) -> Keypoints:
    return Keypoints(
        pixels=np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2),
        sizes=np.array([point.size for point in points], dtype=np.float32),
        angles=np.array([point.angle for point in points], dtype=np.float32),
        responses=np.array([point.response for point in points], dtype=np.float32),
        octaves=np.array(octaves, dtype=np.int32),
        scales=np.array(scales, dtype=np.float32),
        sigmas=np.array(scales, dtype=np.float32),
        descriptors=descriptors,
        norm=norm,
    )


METHODS: Final[dict[FeatureMethod, Callable[[DetectorInput, FeatureOptions], Keypoints]]] = {
    "orb": _detect_orb,
    "sift": _detect_sift,
    "aliked": detect_learned,
    "disk": detect_learned,
    "xfeat": detect_learned,
}
