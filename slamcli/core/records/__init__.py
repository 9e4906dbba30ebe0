"""The records that cross the walls between stages; all frozen, arrays never written to."""

from slamcli.core.records.features import Alignment, DescriptorNorm, Features, Keypoints
from slamcli.core.records.frames import DenseLevel, Frame, Keyframe, Prepared, View
from slamcli.core.records.graph import FloorMap, Link, LinkKind, PoseEstimate, Status
from slamcli.core.records.mosaic import Shot, Tile

__all__ = [
    "Alignment",
    "DenseLevel",
    "DescriptorNorm",
    "Features",
    "FloorMap",
    "Frame",
    "Keyframe",
    "Keypoints",
    "Link",
    "LinkKind",
    "PoseEstimate",
    "Prepared",
    "Shot",
    "Status",
    "Tile",
    "View",
]
