"""Feature extraction: keypoints and descriptors of the bird's-eye view, placed on the floor.

ORB: Rublee et al., ICCV 2011. SIFT: Lowe, IJCV 60, 2004. The low-pass with a threshold
(``clean_image``) and the region of interest are those of the 2015 thesis.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.resolution import floor_sampling, range_sigma
from slamcli.core.config import FeatureOptions
from slamcli.core.geometry import apply_homography
from slamcli.core.records import Features, Keypoints, View
from slamcli.stages.features.detectors import METHODS
from slamcli.stages.features.selection import CLEARANCE_STEP, DetectorInput

# Most cameras' views have one mask.
_MAX_MASKS = 4

__all__ = [
    "METHODS",
    "DetectorInput",
    "clean_image",
    "detect",
    "extract",
    "prepare",
    "seen_clearance",
    "to_features",
]


def extract(
    view: View,
    calibration: Calibration,
    options: FeatureOptions,
    tilt_sigma_radians: float = 0.0,
) -> Features:
    """Find the points of a view and place them on the floor.

    Parameters
    ----------
    view : View
        Gray.
    calibration : Calibration
        Of the camera that saw it: how finely it samples the floor gives the points' sigmas.
    options : FeatureOptions
    tilt_sigma_radians : float
        By how much the camera's pitch varies from frame to frame; it moves points along the line
        of sight.
    """
    return to_features(view, detect(view, options), calibration, tilt_sigma_radians)


def detect(view: View, options: FeatureOptions) -> Keypoints:
    """Find the points of a gray view and describe them, still in its pixels."""
    picture = prepare(view, options)
    return METHODS[options.method](picture, options)


def to_features(
    view: View, keypoints: Keypoints, calibration: Calibration, tilt_sigma_radians: float = 0.0
) -> Features:
    """Place a view's keypoints on the floor, with their standard deviations.

    A point errs by a share of a pixel: of the pixel, of the view or of the camera's picture,
    that is coarser where it lies, times the scale of the pyramid level that it was found on.
    """
    points = apply_homography(view.grid.metres_from_pixel, keypoints.pixels)
    pixel = np.maximum(floor_sampling(calibration, points), view.grid.metres_per_pixel)
    sigmas = pixel * keypoints.sigmas[:, None]
    if tilt_sigma_radians > 0.0:
        sigmas[:, 0] = np.hypot(sigmas[:, 0], range_sigma(calibration, points, tilt_sigma_radians))
    return Features(
        points.astype(np.float32),
        keypoints.descriptors,
        keypoints.responses,
        sigmas.astype(np.float32),
        keypoints.sizes * np.float32(view.grid.metres_per_pixel),
        # The picture's rows run against y.
        -np.radians(keypoints.angles),
        keypoints.norm,
    )


def prepare(view: View, options: FeatureOptions) -> DetectorInput:
    """Return the detector's input from a gray view: cleaned, and where points may lie."""
    gray = view.image
    if options.clean:
        gray = clean_image(gray, options.clean_kernel_pixels, options.clean_threshold)
    if not options.roi:
        return DetectorInput(gray, view.mask, None)
    mask = view.mask.tobytes()
    allowed, clearance = _region_of_interest(mask, view.mask.shape, options.roi_border_pixels)
    return DetectorInput(gray, allowed, clearance)


@lru_cache(maxsize=_MAX_MASKS)
def _region_of_interest(
    mask: bytes, shape: tuple[int, int], border_pixels: int
) -> tuple[UInt8Array, Float32Array]:
    """Return where points may lie in views of one mask, and `seen_clearance` of it."""
    clearance = seen_clearance(np.frombuffer(mask, np.uint8).reshape(shape))
    height, width = shape
    clear = np.where(clearance > border_pixels, np.uint8(255), np.uint8(0))
    allowed = np.repeat(np.repeat(clear, CLEARANCE_STEP, axis=0), CLEARANCE_STEP, axis=1)
    return np.ascontiguousarray(allowed[:height, :width]), clearance


def clean_image(image: UInt8Array, kernel_pixels: int, threshold: int) -> UInt8Array:
    """Return a gray picture low-passed by a box, everything up to the threshold made black."""
    smooth = cv2.blur(image, (kernel_pixels, kernel_pixels))
    _, cleaned = cv2.threshold(smooth, threshold, 255, cv2.THRESH_TOZERO)
    return np.asarray(cleaned, dtype=np.uint8)


def seen_clearance(mask: UInt8Array) -> Float32Array:
    """Return pixels to the nearest unseen one, at one value for `CLEARANCE_STEP` squared pixels.

    What lies outside the picture was not seen either. The coarse raster takes a tenth of the time,
    and errs towards too little.
    """
    step = CLEARANCE_STEP
    height, width = mask.shape
    rows, columns = -(-height // step), -(-width // step)
    whole = cv2.copyMakeBorder(
        mask, 0, rows * step - height, 0, columns * step - width, cv2.BORDER_CONSTANT, value=0
    )
    blocks = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    seen = np.where(np.asarray(blocks) == 255, np.uint8(255), np.uint8(0))
    framed = cv2.copyMakeBorder(seen, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # From anywhere in a block to the near side of the nearest block that is not wholly seen.
    clear = np.maximum(distance[1:-1, 1:-1] - 1.0, 0.0) * step
    return np.asarray(clear, dtype=np.float32)
