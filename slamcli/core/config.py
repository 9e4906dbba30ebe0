"""Options that cross walls, with their defaults; a command's flags and run.toml mirror them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FeatureMethod = Literal["orb", "sift"]
TransformModel = Literal["rigid", "similarity", "affine", "homography"]
MatchFilter = Literal["ratio", "cross-check"]


@dataclass(frozen=True, slots=True)
class FeatureOptions:
    """What is found in a picture. ORB's defaults are OpenCV's and the 2015 thesis's.

    Attributes
    ----------
    method : str
    count : int
        Most points kept a picture.
    scale_factor, levels, edge_threshold, first_level, wta_k, patch_size, fast_threshold
        ORB's own (Rublee et al., ICCV 2011); edge_threshold and patch_size in pixels.
    contrast_threshold : float
        SIFT's own.
    clean : bool
        The thesis's ``clean_image``: a low-pass, then a threshold.
    clean_kernel_pixels : int
        Side of the low-pass's box.
    clean_threshold : int
        Gray level below which a pixel becomes black.
    roi : bool
        The thesis's ``_apply_roi``: leave out points near the border of what was seen.
    roi_border_pixels : int
        How near.
    """

    method: FeatureMethod = "orb"
    count: int = 500
    scale_factor: float = 1.2
    levels: int = 8
    edge_threshold: int = 31
    first_level: int = 0
    wta_k: int = 2
    patch_size: int = 31
    fast_threshold: int = 20
    contrast_threshold: float = 0.04
    clean: bool = False
    clean_kernel_pixels: int = 5
    clean_threshold: int = 100
    roi: bool = True
    roi_border_pixels: int = 16


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How two sets of features become one transform.

    Attributes
    ----------
    model : str
        Degrees of freedom: rigid 3, similarity 4, affine 6, homography 8.
    filter : str
    ratio : float
        Lowe's: best over second-best distance must be below it.
    max_distance : float or None
        Descriptor distance above which a match is dropped (the thesis's cost filter).
    threshold : float
        A match is an inlier when its residual is below this: metres (pixels without calibration).
    confidence : float
        Of RANSAC having drawn one all-inlier sample when it stops.
    max_iterations : int
    min_inliers : int
    seed : int
    """

    model: TransformModel = "rigid"
    filter: MatchFilter = "ratio"
    ratio: float = 0.8
    max_distance: float | None = None
    threshold: float = 3.0
    confidence: float = 0.999
    max_iterations: int = 5000
    min_inliers: int = 8
    seed: int = 0
