"""Dense registration of two views: correlation search, photometric refinement, agreement."""

from slamcli.stages.dense.agreement import (
    Agreement,
    agreement,
    keep_agreeing_points,
    overlap,
    patch_votes,
)
from slamcli.stages.dense.correlation_search import (
    Candidate,
    Search,
    SearchWindow,
    evidence,
    search,
)
from slamcli.stages.dense.lucas_kanade import PhotometricFit, RefinementAssumptions, refine
from slamcli.stages.dense.marks import count_explained, distinguishing_marks, own_marks
from slamcli.stages.dense.obstacles import ObstacleMask, find_obstacles
from slamcli.stages.dense.periodicity import find_periods
from slamcli.stages.dense.photometric_residuals import MotionPrior
from slamcli.stages.dense.pyramid import (
    LevelMask,
    halved,
    make_level_masks,
    make_levels,
)
from slamcli.stages.dense.sparse_view import (
    FloorReading,
    make_sparse_view,
    smoothed_pictures,
    with_detail_of,
)

__all__ = [
    "Agreement",
    "Candidate",
    "FloorReading",
    "LevelMask",
    "MotionPrior",
    "ObstacleMask",
    "PhotometricFit",
    "RefinementAssumptions",
    "Search",
    "SearchWindow",
    "agreement",
    "count_explained",
    "distinguishing_marks",
    "evidence",
    "find_obstacles",
    "find_periods",
    "halved",
    "keep_agreeing_points",
    "make_level_masks",
    "make_levels",
    "make_sparse_view",
    "overlap",
    "own_marks",
    "patch_votes",
    "refine",
    "search",
    "smoothed_pictures",
    "with_detail_of",
]
