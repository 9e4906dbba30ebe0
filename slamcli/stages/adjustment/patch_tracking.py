"""Patch tracking (Lucas-Kanade): the same spots of the floor in two images, to 0.01 pixels.

Patches of one image are searched in the other near where the motion between them predicts them, by
pyramidal inverse-compositional alignment (Baker and Matthews, IJCV 56, 2004), from coarse to fine.
The whitening of a match comes from the patch's structure: along a plain line the shift is unknown
in one direction (aperture problem).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.stages.adjustment.patch_alignment import align_patches, patch_quality
from slamcli.stages.adjustment.patches import (
    HALF_PIXELS,
    Warp,
    cut_patches,
    image_gradients,
    warp_centres,
    warp_jacobian,
)
from slamcli.stages.adjustment.pyramid import MAX_LEVEL, Pyramid

# Weaker gradients, in gray levels per pixel, are the camera's noise.
# [Both are guarded by benchmarks/self_calibration.py.]
_MIN_GRADIENT_GRAY = 1.5
# A corner fixes both directions; a line, which fixes one, is worth this share of it.
_LINE_SHARE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Spots of the floor that two frames both see.

    Attributes
    ----------
    a, b : int
        Frame indices.
    pixels_a, pixels_b : (N, 2) float64
        In the frames' own images.
    whitening : (N, 2, 2) float64
        Turns an error of `pixels_b` into standard deviations.
    """

    a: int
    b: int
    pixels_a: Float64Array
    pixels_b: Float64Array
    whitening: Float64Array

    def __len__(self) -> int:
        return len(self.pixels_a)


def pixel_information(pyramid: Pyramid, level: int = 0) -> Float32Array:
    """Return (H, W): how well each usable pixel's patch fixes a motion; 0 where it is too weak.

    Parameters
    ----------
    pyramid : Pyramid
    level : int
        That it is found on. At half the size it takes a quarter of the time, and refined cameras
        are up to three times as far off [benchmarks/self_calibration.py: concrete].
    """
    image, mask = pyramid.images[level], pyramid.masks[level]
    information = np.zeros_like(image)
    left, top, width, height = cv2.boundingRect(mask)
    # And as much around the usable floor as its pixels' patches and their gradients reach.
    rows, columns = (
        slice(max(0, start - HALF_PIXELS - 1), start + size + HALF_PIXELS + 1)
        for start, size in ((top, height), (left, width))
    )
    information[rows, columns] = _information(image[rows, columns], level)
    if level:
        full = pyramid.images[0].shape[::-1]
        information = np.asarray(cv2.resize(information, full, interpolation=cv2.INTER_NEAREST))
    return information


def _information(image: Float32Array, level: int) -> Float32Array:
    right, down = image_gradients(image)
    half = HALF_PIXELS >> level
    side = (2 * half + 1, 2 * half + 1)
    xx, yy, xy = (
        cv2.blur(cv2.multiply(a, b), side) for a, b in ((right, right), (down, down), (right, down))
    )
    # The eigenvalues of the structure tensor are middle + spread and middle - spread.
    middle = cv2.addWeighted(xx, 0.5, yy, 0.5, 0.0)
    spread = cv2.magnitude(cv2.addWeighted(xx, 0.5, yy, -0.5, 0.0), xy)
    least, most = np.maximum(cv2.subtract(middle, spread), 0.0), cv2.add(middle, spread)
    information = cv2.scaleAdd(most, _LINE_SHARE, least)
    information[most <= (_MIN_GRADIENT_GRAY * 2**level) ** 2] = 0.0
    return np.asarray(information, np.float32)


def choose_points(
    pyramid: Pyramid, information: Float32Array, seen: UInt8Array, count: int
) -> Float64Array:
    """Return up to about `count` (N, 2) most informative pixels, one in each cell of a raster.

    Parameters
    ----------
    pyramid : Pyramid
    information : (H, W) float32
        From `pixel_information`.
    seen : (H, W) uint8
        255 where the other frame sees the same floor.
    """
    usable = cv2.erode(np.minimum(pyramid.masks[0], seen), np.ones((5, 5)))
    area = int(np.count_nonzero(usable == 255))
    cell = max(4, math.ceil(math.sqrt(area / count)))
    information = np.where(usable == 255, information, np.float32(0.0))
    rows, columns = information.shape[0] // cell, information.shape[1] // cell
    cells = information[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    flat = cells.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = np.argmax(flat, axis=1)
    found = flat[np.arange(len(flat)), best] > 0.0
    row, column = np.divmod(np.arange(len(flat)), columns)
    points = np.column_stack([column * cell + best % cell, row * cell + best // cell])
    return np.asarray(points[found], np.float64)


def track(
    first: Pyramid,
    second: Pyramid,
    points: Float64Array,
    second_from_first: Warp,
    coarsest: int = MAX_LEVEL,
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Find points of one image in another.

    Parameters
    ----------
    points : (N, 2) float64
        Pixels of the first.
    second_from_first : callable
        Maps (M, 2) pixels by the predicted motion; nan where the other cannot see them.
    coarsest : int
        Level to start at: 0 when the prediction is within a few pixels, 3 within some 30.

    Returns
    -------
    kept : (K,) int
        Which of the points were found.
    pixels : (K, 2) float64
        Of the second.
    whitening : (K, 2, 2) float64
        Of those.
    """
    shift = np.zeros_like(points)
    alive = np.arange(len(points))
    for level in range(coarsest, 0, -1):
        patches = cut_patches(first, second, points[alive], second_from_first, level)
        good = patches.good
        shift[alive[good]] = align_patches(patches, shift[alive])[good]
        alive = alive[np.isfinite(patches.coefficients).all(axis=(1, 2))]
    patches = cut_patches(first, second, points[alive], second_from_first, 0)
    start = shift[alive]
    found = align_patches(patches, start)
    quality = patch_quality(patches, found)
    good = patches.good & quality.good
    pixels = warp_centres(patches.coefficients, found)
    jacobian = warp_jacobian(patches.coefficients, found)
    good &= np.abs(np.linalg.det(jacobian)) > 1e-6
    whitening = quality.whitening[good] @ np.linalg.inv(jacobian[good])
    return alive[good], pixels[good], whitening
