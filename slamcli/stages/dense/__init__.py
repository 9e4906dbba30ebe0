"""Two views compared pixel by pixel: searched, refined, and judged."""

from slamcli.stages.dense.agreement import Agreement, agreeing, agreement, overlap, preference
from slamcli.stages.dense.correlation_search import Candidate, Search, Window, evidence, search
from slamcli.stages.dense.lucas_kanade import Known, Refinement, refine
from slamcli.stages.dense.obstacles import Standing, standing
from slamcli.stages.dense.periodicity import repeats
from slamcli.stages.dense.pyramid import (
    Stencil,
    levels_from_half,
    make_levels,
    make_stencils,
    stencils_from_half,
)

__all__ = [
    "Agreement",
    "Candidate",
    "Known",
    "Refinement",
    "Search",
    "Standing",
    "Stencil",
    "Window",
    "agreeing",
    "agreement",
    "evidence",
    "levels_from_half",
    "make_levels",
    "make_stencils",
    "overlap",
    "preference",
    "refine",
    "repeats",
    "search",
    "standing",
    "stencils_from_half",
]
