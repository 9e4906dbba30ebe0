"""ORB and SIFT through OpenCV: spread over the picture and placed to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np

from slamcli.core.geometry import Grid, apply_homography
from slamcli.core.records import Keypoints
from slamcli.stages.features import subpixel

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from slamcli.core.config import FeatureMethod, FeatureOptions
    from slamcli.core.records import DescriptorNorm

# Pixels to the side of one value of Picture.clearance.
CLEARANCE_STEP = 4
# Spreading picks among this many times the points asked for: a painted line must not use them all
# up. ORB finds them at little extra cost.
_ORB_SURPLUS = 12
# SIFT describes what it finds at once, which costs; its points crowd less.
_SIFT_SURPLUS = 4
# Enough that a cell of sharp paint gives more than one of dull floor, which matches worse.
_POINTS_PER_CELL = 16
# One sigma in pixels of the level a point was found on, by the residuals of true matches on
# asphalt-like noise.
_REFINED_SIGMA_PIXELS = 0.25
_CORNER_SIGMA_PIXELS = 0.5
_SIFT_SIGMA_PIXELS = 0.2
_ORB_DESCRIPTOR_BYTES = 32
_SIFT_DIMENSIONS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What a detector is shown of a view.

    Attributes
    ----------
    gray : (h, w) uint8
        Cleaned, if so asked.
    allowed : (h, w) uint8
        255 where a point may lie.
    clearance : (h / 4, w / 4) float32 or None
        Pixels to the nearest that was not seen, one value for `CLEARANCE_STEP` pixels each way;
        None without a region of interest.
    """

    gray: NDArray[np.uint8]
    allowed: NDArray[np.uint8]
    clearance: NDArray[np.float32] | None


def _detect_orb(picture: Picture, options: FeatureOptions) -> Keypoints:
    levels = _usable_levels(picture.gray, options)
    orb = _orb(options, levels, options.fast_threshold)
    found = orb.detect(picture.gray, picture.allowed)
    if len(found) < options.count and options.min_fast_threshold < options.fast_threshold:
        orb = _orb(options, levels, options.min_fast_threshold)
        found = orb.detect(picture.gray, picture.allowed)
    scales = [_orb_scale(options, point.octave) for point in found]
    chosen = [found[index] for index in _choose(picture, found, scales, options)]
    described, descriptors = orb.compute(picture.gray, chosen)
    octaves = [point.octave for point in described]
    corners = _keypoints(
        described,
        np.asarray(descriptors if described else [], np.uint8).reshape(-1, _ORB_DESCRIPTOR_BYTES),
        octaves,
        [_orb_scale(options, octave) for octave in octaves],
        "hamming" if options.wta_k == 2 else "hamming2",
    )
    return _place_on_levels(corners, picture.gray, options)


def _usable_levels(gray: NDArray[np.uint8], options: FeatureOptions) -> int:
    """Return how many levels are larger than the border that is left out of each.

    Smaller ones hold no point, and OpenCV fails when one has no pixel left.
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


def _place_on_levels(
    keypoints: Keypoints, gray: NDArray[np.uint8], options: FeatureOptions
) -> Keypoints:
    """Mend where OpenCV puts ORB's points, and refine them if so asked.

    OpenCV multiplies a level's whole pixels by the level's scale. That leaves out that the centre
    of a coarse pixel lies half a coarse pixel from its corner, and that a level has a whole number
    of pixels, so that its true scale differs by up to half a pixel at the far border.
    """
    corners = np.rint(keypoints.pixels / keypoints.scales[:, None]).astype(np.int64)
    pixels, sigmas = np.empty_like(keypoints.pixels), np.empty_like(keypoints.sigmas)
    level_image = gray
    for octave in range(int(keypoints.octaves.max(initial=-1)) + 1):
        scale = _orb_scale(options, octave)
        # OpenCV builds each level from the one before, the enlarged ones from the picture itself.
        source = gray if octave <= options.first_level else level_image
        level_image = _shrink(source, gray.shape, scale)
        here = keypoints.octaves == octave
        places, found = corners[here].astype(np.float64), np.zeros(np.count_nonzero(here), np.bool_)
        if options.refine:
            places, found = subpixel.refine(level_image, corners[here])
        sigmas[here] = np.where(found, _REFINED_SIGMA_PIXELS, _CORNER_SIGMA_PIXELS) * scale
        pixels[here] = apply_homography(_pixel_from_level(gray.shape, level_image.shape), places)
    return replace(keypoints, pixels=pixels, sigmas=sigmas)


def _shrink(
    source: NDArray[np.uint8], full_shape: tuple[int, ...], scale: float
) -> NDArray[np.uint8]:
    size = (round(full_shape[1] / scale), round(full_shape[0] / scale))
    if size == source.shape[::-1]:
        return source
    resized = cv2.resize(source, size, interpolation=cv2.INTER_LINEAR_EXACT)
    return np.asarray(resized, dtype=np.uint8)


def _pixel_from_level(
    full_shape: tuple[int, ...], level_shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """(3, 3): pixel of a pyramid level to pixel of the picture; their outer corners coincide."""
    fine = Grid(0.0, 0.0, 1.0, 1, 1)
    across, down = (
        fine.pixel_from_metres
        @ Grid(0.0, 0.0, full_shape[axis] / level_shape[axis], 1, 1).metres_from_pixel
        for axis in (1, 0)
    )
    return np.array([across[0], down[1], [0.0, 0.0, 1.0]])


def _detect_sift(picture: Picture, options: FeatureOptions) -> Keypoints:
    sift = cv2.SIFT.create(
        nfeatures=options.count * (_SIFT_SURPLUS if options.spread else 1),
        contrastThreshold=options.contrast_threshold,
        # Without it, doubling the picture shifts every point by a quarter of a pixel.
        enable_precise_upscale=True,
    )
    # One call for both: describing the surplus too costs less than a second scale space.
    found, all_descriptors = sift.detectAndCompute(picture.gray, picture.allowed)
    scales = [2.0 ** _sift_octave(point) for point in found]
    chosen = _choose(picture, found, scales, options)
    points = [found[index] for index in chosen]
    described = np.asarray(all_descriptors if found else [], np.float32)
    octaves = [_sift_octave(point) for point in points]
    keypoints = _keypoints(
        points,
        described.reshape(-1, _SIFT_DIMENSIONS)[chosen],
        octaves,
        [2.0**octave for octave in octaves],
        "l2",
    )
    return replace(keypoints, sigmas=_SIFT_SIGMA_PIXELS * keypoints.scales)


def _sift_octave(point: cv2.KeyPoint) -> int:
    """Return the octave, -1 for the doubled picture, from the byte that OpenCV packs it into."""
    octave = point.octave & 255
    return octave - 256 if octave > 127 else octave


METHODS: Final[dict[FeatureMethod, Callable[[Picture, FeatureOptions], Keypoints]]] = {
    "orb": _detect_orb,
    "sift": _detect_sift,
}


def _choose(
    picture: Picture,
    found: Sequence[cv2.KeyPoint],
    scales: Sequence[float],
    options: FeatureOptions,
) -> list[int]:
    """Return which points to keep: patches wholly on seen floor, strong, spread if so asked."""
    if not found:
        return []
    pixels = np.array([point.pt for point in found])
    responses = np.array([point.response for point in found])
    keep = np.arange(len(found))
    if picture.clearance is not None:
        column, row = np.rint(pixels).astype(np.int64).T // CLEARANCE_STEP
        rows, columns = picture.clearance.shape
        clearance = picture.clearance[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        keep = np.flatnonzero(clearance > options.roi_border_pixels * np.maximum(scales, 1.0))
    if len(keep) > options.count:
        if options.spread:
            area = float(np.count_nonzero(picture.allowed))
            cell = np.sqrt(_POINTS_PER_CELL * area / options.count)
            order = _spread_order(pixels[keep], responses[keep], max(cell, 1.0))
        else:
            order = np.argsort(-responses[keep], kind="stable")
        keep = np.sort(keep[order[: options.count]])
    return [int(index) for index in keep]


def _spread_order(
    pixels: NDArray[np.float64], responses: NDArray[np.float64], cell_pixels: float
) -> NDArray[np.int64]:
    """Order points so that any first few are spread: each cell's strongest, then its second ..."""
    column, row = np.floor(pixels / cell_pixels).astype(np.int64).T
    cell = row * (column.max() + 1) + column
    by_cell = np.lexsort((-responses, cell))
    cell = cell[by_cell]
    starts = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
    rank = np.empty(len(cell), dtype=np.int64)
    lengths = np.diff(np.r_[starts, len(cell)])
    rank[by_cell] = np.arange(len(cell)) - np.repeat(starts, lengths)
    return np.lexsort((-responses, rank))


def _keypoints(
    points: Sequence[cv2.KeyPoint],
    descriptors: NDArray[np.uint8] | NDArray[np.float32],
    octaves: Sequence[int],
    scales: Sequence[float],
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
