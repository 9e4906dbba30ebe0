"""Two views compared pixel by pixel: searched, refined, and judged."""

from slamcli.stages.dense.agreement import Agreement, agreement, overlap
from slamcli.stages.dense.levels import make_levels
from slamcli.stages.dense.refinement import Refinement, refine
from slamcli.stages.dense.search import Candidate, Search, Window, evidence, search
from slamcli.stages.dense.standing import Standing, standing

__all__ = [
    "Agreement",
    "Candidate",
    "Refinement",
    "Search",
    "Standing",
    "Window",
    "agreement",
    "evidence",
    "make_levels",
    "overlap",
    "refine",
    "search",
    "standing",
]
