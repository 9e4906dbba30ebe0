"""Pairs of frames: their matches, the homography that explains them, the pixels that verify it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, IntpArray
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey import overlap_pixels
from slamcli.survey.features import SurveyFeatures, rank_in_group

# A descriptor's best match must be nearer than this share of the second best, and be mutual.
# [All thresholds here: guarded by benchmarks/real_sets.py.]
_RATIO, _COARSE_RATIO = 0.85, 0.9
# An inlier is within this share of the picture's longer side: real planes have relief, and lenses
# distortion, which the bundle adjustment estimates later.
_THRESHOLD_SHARE, _MIN_THRESHOLD_PIXELS = 0.0025, 1.5
_MAX_ITERATIONS, _CONFIDENCE = 3000, 0.9999
# A true motion explains this share of all matches inside of its overlap (after Brown and Lowe,
# IJCV 74, 2007, section 3.2, with looser thresholds, as the pixels are compared too).
_MIN_INLIERS, _INLIER_OFFSET, _INLIER_SHARE = 14, 8, 0.15
# A similarity is preferred when it has this many times the homography's inliers.
_SIMPLER_FACTOR, _SIMILARITY_SLACK = 1.3, 2.0
# Of a plausible homography anywhere among its inliers: ratio of the scales in two directions,
# scale, and ratio of the depths to that in the picture's middle.
_MAX_STRETCH, _MAX_SCALE, _MAX_DEPTH_RATIO = 2.5, 6.0, 5.0
_MIN_CORRELATION, _MIN_OVERLAP = 0.15, 0.015
_MAX_MATCHES, _MATCH_CELLS = 150, 12


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two frames that show the same part of the plane.

    Attributes
    ----------
    a, b : int
        Numbers of the frames, a < b.
    a_from_b : (3, 3) float64
        Homography between pixels from the pictures' middles.
    pixels_a, pixels_b : (N, 2) float64
        Matches that agree with it, spread over the overlap.
    inliers : int
        How many matches agree in all.
    correlation : float
        Of the overlap's pixels, normalised.
    reason : str
        Why the two are not accepted as a pair; empty when they are.
    unrelated_share : float
        Estimate of how much of the overlap shows unrelated floor, see `overlap_pixels`.
    """

    a: int
    b: int
    a_from_b: Float64Array
    pixels_a: Float64Array
    pixels_b: Float64Array
    inliers: int
    correlation: float
    reason: str = ""
    unrelated_share: float = 0.0

    @property
    def strength(self) -> float:
        """Evidence for the pair: the matches that agree, times the pixels' correlation."""
        return self.inliers * self.correlation

    @property
    def median_pixels(self) -> float:
        """Median distance of the matches under the pair's own homography."""
        there = apply_homography(self.a_from_b, self.pixels_b)
        return float(np.median(np.linalg.norm(there - self.pixels_a, axis=1)))


def coarse_votes(first: SurveyFeatures, second: SurveyFeatures) -> int:
    """Return how many of the largest points of two frames are mutual, distinct nearest matches."""
    a, b = first.descriptors[first.coarse], second.descriptors[second.coarse]
    return len(_mutual(a, b, _COARSE_RATIO)[0])


def match(first: SurveyFeatures, second: SurveyFeatures) -> tuple[Float64Array, Float64Array]:
    """Return (N, 2) pixels of the matches of two frames in each of them, from their middles."""
    rows, columns = _mutual(first.descriptors, second.descriptors, _RATIO)
    return first.pixels[rows], second.pixels[columns]


def find_pair(a: int, b: int, first: SurveyFeatures, second: SurveyFeatures) -> Pair:
    """Return the pair of two frames, or the reason why they are none."""
    points_a, points_b = match(first, second)

    def rejected(reason: str, inliers: int, correlation: float = 0.0) -> Pair:
        return Pair(a, b, np.eye(3), points_a[:0], points_b[:0], inliers, correlation, reason)

    if len(points_a) < _MIN_INLIERS:
        return rejected("too few matches", len(points_a))
    threshold = max(_MIN_THRESHOLD_PIXELS, _THRESHOLD_SHARE * max(*first.size, *second.size))
    a_from_b, inliers = _motion(points_a, points_b, threshold)
    count = int(inliers.sum())
    if count < _MIN_INLIERS:
        return rejected("no common motion of the matches", count)
    expected = _matches_in_overlap(a_from_b, points_a, points_b, first.size, second.size)
    if count < _INLIER_OFFSET + _INLIER_SHARE * expected:
        return rejected("most matches of the overlap contradict the motion", count)
    correlation, overlap = overlap_pixels.correlation(first, second, a_from_b)
    if overlap < _MIN_OVERLAP:
        return rejected("overlap too small", count, correlation)
    unrelated = overlap_pixels.unrelated_share(first, second, a_from_b)
    if correlation < _MIN_CORRELATION or unrelated > overlap_pixels.MAX_UNRELATED_SHARE:
        return rejected("pixels of the overlap differ", count, correlation)
    kept = np.flatnonzero(inliers)
    kept = kept[_spread(points_a[kept], first.size)]
    pixels = points_a[kept], points_b[kept]
    return Pair(a, b, a_from_b, *pixels, count, correlation, unrelated_share=unrelated)


def fit_similarity(
    source: Float64Array, target: Float64Array, weights: Float64Array | None = None
) -> Float64Array:
    """Return the (3, 3) least-squares similarity between (N, 2) point pairs, target from source."""
    z, w = source @ [1.0, 1.0j], target @ [1.0, 1.0j]
    centre, mean = np.average(z, weights=weights), np.average(w, weights=weights)
    centred = z - centre
    counted = centred if weights is None else weights * centred
    factor = complex(np.vdot(counted, w - mean) / np.vdot(counted, centred))
    shift = complex(mean - factor * centre)
    return np.array(
        [
            [factor.real, -factor.imag, shift.real],
            [factor.imag, factor.real, shift.imag],
            [0.0, 0.0, 1.0],
        ]
    )


def _mutual(first: Float32Array, second: Float32Array, ratio: float) -> tuple[IntpArray, IntpArray]:
    """Return the rows of both of the matches that are mutual and pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    similar = first @ second.T
    forward = similar.argmax(axis=1)
    every = np.arange(len(first))
    best = similar[every, forward]
    mutual = best == similar.max(axis=0)[forward]
    similar[every, forward] = -1.0
    # Squared distances of unit vectors are 2 - 2 cos.
    clear = 1.0 - best < ratio**2 * (1.0 - similar.max(axis=1))
    rows = np.flatnonzero(mutual & clear)
    return rows, forward[rows]


def _motion(
    points_a: Float64Array, points_b: Float64Array, threshold: float
) -> tuple[Float64Array, BoolArray]:
    """Return the homography (MAGSAC) or the similarity that explains more; no inliers if none."""
    none = np.zeros(len(points_a), np.bool_)
    best, inliers = np.eye(3), none
    found, mask = cv2.findHomography(
        points_b, points_a, cv2.USAC_MAGSAC, threshold, None, _MAX_ITERATIONS, _CONFIDENCE
    )
    if found is not None:
        agree = np.asarray(mask).ravel() > 0
        if agree.any() and plausible(np.asarray(found, np.float64), points_b[agree]):
            best, inliers = np.asarray(found, np.float64), agree
    # OpenCV draws RANSAC's samples from a generator of its own.
    cv2.setRNGSeed(0)
    simple, mask = cv2.estimateAffinePartial2D(
        points_b,
        points_a,
        method=cv2.RANSAC,
        ransacReprojThreshold=_SIMILARITY_SLACK * threshold,
        maxIters=_MAX_ITERATIONS,
        confidence=_CONFIDENCE,
    )
    if simple is None:
        return best, inliers
    agree = np.asarray(mask).ravel() > 0
    if agree.sum() > max(_SIMPLER_FACTOR * inliers.sum(), 2):
        similarity = fit_similarity(points_b[agree], points_a[agree])
        if plausible(similarity, points_b[agree]):
            return similarity, agree
    return best, inliers


def plausible(homography: Float64Array, points: Float64Array) -> bool:
    """Return whether a homography could be of one plane seen twice, nowhere folded or crushed."""
    if abs(homography[2, 2]) < 1e-12:
        return False
    scaled = homography / homography[2, 2]
    depth = points @ scaled[2, :2] + 1.0
    if depth.min() < 1.0 / _MAX_DEPTH_RATIO or depth.max() > _MAX_DEPTH_RATIO:
        return False
    mapped = apply_homography(scaled, points)
    jacobian = scaled[None, :2, :2] - mapped[:, :, None] * scaled[None, 2:, :2]
    jacobian = jacobian / depth[:, None, None]
    scales = np.linalg.svd(jacobian, compute_uv=False)
    if scales[:, 1].min() < 1.0 / _MAX_SCALE or scales.max() > _MAX_SCALE:
        return False
    even = (scales[:, 0] / scales[:, 1]).max() < _MAX_STRETCH
    return bool(even and np.linalg.det(jacobian).min() > 0.0)


def _matches_in_overlap(
    a_from_b: Float64Array,
    points_a: Float64Array,
    points_b: Float64Array,
    size_a: tuple[int, int],
    size_b: tuple[int, int],
) -> int:
    """Return how many matches have both points in the overlap that the motion gives."""
    there = np.abs(apply_homography(a_from_b, points_b)) < np.array(size_a) / 2
    back = np.abs(apply_homography(invert(a_from_b), points_a)) < np.array(size_b) / 2
    return int((there.all(axis=1) & back.all(axis=1)).sum())


def _spread(points: Float64Array, size: tuple[int, int]) -> IntpArray:
    """Return which points to keep: some of every part of the picture."""
    cells = np.floor((points / np.array(size) + 0.5) * _MATCH_CELLS).astype(np.intp)
    rank = rank_in_group(cells[:, 1] * _MATCH_CELLS + cells[:, 0])
    return np.sort(np.argsort(rank, kind="stable")[:_MAX_MATCHES])
