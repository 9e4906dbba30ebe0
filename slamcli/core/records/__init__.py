"""The records that stages exchange; all frozen, their arrays never written to."""

from slamcli.core.records.features import DescriptorNorm, FeatureAlignment, Features, Keypoints
from slamcli.core.records.frames import (
    NO_PERIODS,
    NO_SPARSE_VIEW,
    Frame,
    Keyframe,
    NormalisedDetail,
    PreparedFrame,
    PyramidLevel,
    Pyramids,
    SampledLevel,
    SparseView,
    Template,
    View,
)
from slamcli.core.records.graph import FloorMap, Link, LinkKind, PoseEstimate, Status
from slamcli.core.records.mosaic import FloorEvidence, PosedFrame, Tile

__all__ = [
    "NO_PERIODS",
    "NO_SPARSE_VIEW",
    "DescriptorNorm",
    "FeatureAlignment",
    "Features",
    "FloorEvidence",
    "FloorMap",
    "Frame",
    "Keyframe",
    "Keypoints",
    "Link",
    "LinkKind",
    "NormalisedDetail",
    "PoseEstimate",
    "PosedFrame",
    "PreparedFrame",
    "PyramidLevel",
    "Pyramids",
    "SampledLevel",
    "SparseView",
    "Status",
    "Template",
    "Tile",
    "View",
]
