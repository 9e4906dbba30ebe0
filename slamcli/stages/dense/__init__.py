"""Two views compared pixel by pixel: searched, refined, and judged."""

from slamcli.stages.dense.agreement import Agreement, agreement, overlap
from slamcli.stages.dense.levels import levels_from_half, make_levels
from slamcli.stages.dense.refinement import Refinement, refine
from slamcli.stages.dense.search import Candidate, Search, Window, evidence, search

__all__ = [
    "Agreement",
    "Candidate",
    "Refinement",
    "Search",
    "Window",
    "agreement",
    "evidence",
    "levels_from_half",
    "make_levels",
    "overlap",
    "refine",
    "search",
]
