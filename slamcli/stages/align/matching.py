"""Descriptor matching: which point of one view is which point of the other."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int32Array, UInt8Array
from slamcli.core.config import MatchOptions
from slamcli.core.geometry import apply_homography
from slamcli.core.networks import MatchNetwork
from slamcli.core.records import DescriptorNorm, Features

# Without a radius of the user's, matches within this many typical sigmas of a guess are tried
# [guarded by tests/stages/test_align.py].
_SEARCH_SIGMAS = 100.0
_NORMS: Final[dict[DescriptorNorm, int]] = {
    "hamming": cv2.NORM_HAMMING,
    "hamming2": cv2.NORM_HAMMING2,
    "l2": cv2.NORM_L2,
}


def match_descriptors(
    a: Features,
    b: Features,
    options: MatchOptions,
    guess: Float64Array | None = None,
) -> tuple[Int32Array, Float32Array]:
    """Pair points by brute force, or by the options' network.

    Parameters
    ----------
    a, b : Features
        Of one kind.
    options : MatchOptions
        The filter (Lowe's ratio, or each other's best) and the largest distance.
    guess : (3, 3) or None
        ``a_from_b``; pairs farther from it than the options' search radius are not tried.

    Returns
    -------
    pairs : (M, 2) int32
        Indices into a and b, in the order of a; no point occurs twice.
    distances : (M,) float32
        Of the descriptors.
    """
    if len(a) == 0 or len(b) == 0:
        return np.empty((0, 2), np.int32), np.empty(0, np.float32)
    mask = None if guess is None else _near_guess(a, b, guess, options)
    if options.network is not None:
        return _by_network(a, b, options.network, options.max_distance, mask)
    distances, neighbours = _nearest(a, b, mask)
    best, found = distances[:, 0], neighbours[:, 0]
    keep = found >= 0
    if options.filter == "ratio":
        # A single candidate, within a guess's radius, has nothing to be mistaken for.
        second = np.where(neighbours[:, 1] >= 0, distances[:, 1], np.inf)
        keep &= best < options.ratio * second
    if options.max_distance is not None:
        keep &= best <= options.max_distance
    if options.max_size_ratio is not None:
        larger = a.sizes / b.sizes[found]
        keep &= np.maximum(larger, 1.0 / larger) <= options.max_size_ratio
    if options.filter == "cross-check":
        _, back = _nearest(b, a, None if mask is None else np.ascontiguousarray(mask.T))
        keep &= back[found, 0] == np.arange(len(a))
    index_a = np.flatnonzero(keep)
    pairs = np.column_stack([index_a, found[index_a]]).astype(np.int32)
    return _unique(pairs, best[index_a])


def _by_network(
    a: Features,
    b: Features,
    network: MatchNetwork,
    max_distance: float | None,
    mask: UInt8Array | None,
) -> tuple[Int32Array, Float32Array]:
    """Pair the points by a network; drop what the mask and the distance do not allow."""
    everywhere = np.concatenate([a.points, b.points])
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    # A picture's columns run along x and its rows against y. The extent of all points stands in for
    # the picture's own, which is not known here; it only has to be the same for both views.
    halves = np.maximum((high - low) / 2, np.finfo(np.float32).eps) * (1.0, -1.0)
    middle = (low + high) / 2
    pairs, distances = network.match(
        ((a.points - middle) / halves).astype(np.float32),
        ((b.points - middle) / halves).astype(np.float32),
        a.descriptors.astype(np.float32),
        b.descriptors.astype(np.float32),
    )
    keep = np.ones(len(pairs), np.bool_) if mask is None else mask[pairs[:, 0], pairs[:, 1]] > 0
    if max_distance is not None:
        keep &= distances <= max_distance
    return _unique(pairs[keep], distances[keep])


def _nearest(
    query: Features, train: Features, mask: UInt8Array | None
) -> tuple[Float32Array, Int32Array]:
    """Return distances (N, 2) and indices (N, 2) of each query's two nearest; index -1: none."""
    norm = _NORMS[query.norm]
    kind = cv2.CV_32F if query.norm == "l2" else cv2.CV_32S
    neighbours = min(2, len(train))
    found, index = cv2.batchDistance(
        query.descriptors, train.descriptors, kind, normType=norm, K=neighbours, mask=mask
    )
    distances = np.full((len(query), 2), np.inf, dtype=np.float32)
    indices = np.full((len(query), 2), -1, dtype=np.int32)
    distances[:, :neighbours], indices[:, :neighbours] = found, index
    return distances, indices


def _near_guess(
    a: Features, b: Features, a_from_b: Float64Array, options: MatchOptions
) -> UInt8Array:
    """Return the (Na, Nb) mask of pairs that the guess and its uncertainty allow."""
    expected = apply_homography(a_from_b, b.points)
    centre = apply_homography(a_from_b, np.zeros(2))
    reach = np.linalg.norm(expected - centre, axis=1)
    radius = options.search_radius
    if radius is None:
        radius = _SEARCH_SIGMAS * float(np.median(b.sigmas))
    radius = radius + options.search_angle_radians * reach
    # |a - e|^2 - r^2 as one product of (x, y, |a|^2, 1) and (-2 e_x, -2 e_y, 1, |e|^2 - r^2), from
    # the views' middle so that float32 is fine enough.
    middle = expected.mean(axis=0)
    places, goals = a.points - middle, expected - middle
    squares = np.sum(places**2, axis=1), np.sum(goals**2, axis=1) - radius**2
    left = np.column_stack([places, squares[0], np.ones(len(a))]).astype(np.float32)
    right = np.column_stack([-2.0 * goals, np.ones(len(b)), squares[1]]).astype(np.float32)
    return (left @ right.T <= 0.0).view(np.uint8)


def _unique(pairs: Int32Array, distances: Float32Array) -> tuple[Int32Array, Float32Array]:
    """Keep, of pairs that share a point of b, the one that is most alike."""
    order = np.lexsort((pairs[:, 0], distances))
    _, first = np.unique(pairs[order, 1], return_index=True)
    kept = np.sort(order[first])
    return pairs[kept], distances[kept]
