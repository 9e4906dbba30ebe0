"""The records that stages exchange; all frozen, their arrays never written to."""

from slamcli.core.records.features import DescriptorNorm, FeatureAlignment, Features, Keypoints
from slamcli.core.records.frames import Frame, Keyframe, PreparedFrame, PyramidLevel, View
from slamcli.core.records.graph import FloorMap, Link, LinkKind, PoseEstimate, Status
from slamcli.core.records.mosaic import PosedFrame, Tile

__all__ = [
    "DescriptorNorm",
    "FeatureAlignment",
    "Features",
    "FloorMap",
    "Frame",
    "Keyframe",
    "Keypoints",
    "Link",
    "LinkKind",
    "PoseEstimate",
    "PosedFrame",
    "PreparedFrame",
    "PyramidLevel",
    "Status",
    "Tile",
    "View",
]
