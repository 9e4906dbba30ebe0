"""Two views compared pixel by pixel: searched, refined, and judged."""

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
from slamcli.stages.dense.lucas_kanade import MotionPrior, PhotometricFit, refine
from slamcli.stages.dense.obstacles import ObstacleMask, find_obstacles
from slamcli.stages.dense.periodicity import find_periods
from slamcli.stages.dense.pyramid import (
    LevelMask,
    levels_from_half,
    make_levels,
    make_stencils,
    stencils_from_half,
)

__all__ = [
    "Agreement",
    "Candidate",
    "LevelMask",
    "MotionPrior",
    "ObstacleMask",
    "PhotometricFit",
    "Search",
    "SearchWindow",
    "agreement",
    "evidence",
    "find_obstacles",
    "find_periods",
    "keep_agreeing_points",
    "levels_from_half",
    "make_levels",
    "make_stencils",
    "overlap",
    "patch_votes",
    "refine",
    "search",
    "stencils_from_half",
]
