"""Two views compared pixel by pixel: searched, refined, and judged."""

from slamcli.stages.dense.agreement import Agreement, agreeing, agreement, overlap, preference
from slamcli.stages.dense.levels import (
    Stencil,
    levels_from_half,
    make_levels,
    make_stencils,
    stencils_from_half,
)
from slamcli.stages.dense.refinement import Known, Refinement, refine
from slamcli.stages.dense.repetition import repeats
from slamcli.stages.dense.search import Candidate, Search, Window, evidence, search
from slamcli.stages.dense.standing import Standing, standing

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
