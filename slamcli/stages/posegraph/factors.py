"""Sensor readings that enter a pose graph beside its links, and its solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2


@dataclass(frozen=True, slots=True)
class HeadingReading:
    """A compass reading, attached to a frame.

    Attributes
    ----------
    frame : int
    frame_from_robot : Pose2
        From the frame to the moment of the reading.
    heading_radians : float
        Counter-clockwise from the compass's own zero.
    sigma_radians : float
    share : float
        Weight in (0, 1]: below 1 for readings so dense that their errors are correlated.
    """

    frame: int
    frame_from_robot: Pose2
    heading_radians: float
    sigma_radians: float
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class PositionReading:
    """A GPS reading, attached to a frame.

    Attributes
    ----------
    frame : int
    frame_from_robot : Pose2
        From the frame to the moment of the reading.
    east_metres, north_metres : float
        From the datum.
    sigma_metres : float
    share : float
        Weight in (0, 1]: below 1 for readings so dense that their errors are correlated.
    """

    frame: int
    frame_from_robot: Pose2
    east_metres: float
    north_metres: float
    sigma_metres: float
    share: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SensorOffsets:
    """Offsets that all readings of a sensor share: compass, GPS frame, GPS antenna.

    Attributes
    ----------
    compass_offset_radians, compass_offset_sigma_radians : float
        The compass's heading minus that in the map.
    east_north_from_map : Pose2
    east_north_covariance : (3, 3) float64
        Of x, y (m), theta (rad), in the map's axes.
    lever_arm_metres : (float, float)
        Of the GPS antenna, ahead and to the left.
    """

    compass_offset_radians: float
    compass_offset_sigma_radians: float
    east_north_from_map: Pose2
    east_north_covariance: Float64Array
    lever_arm_metres: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SensorReadings:
    """The readings of one component's frames, and what is known of their offsets beforehand.

    Attributes
    ----------
    headings : sequence of HeadingReading
    positions : sequence of PositionReading
    lever_arm_metres : (float, float) or None
        Of the GPS antenna; None estimates it.
    prior : SensorOffsets or None
        By other readings than these; its lever arm is taken for exact.
    """

    headings: Sequence[HeadingReading] = ()
    positions: Sequence[PositionReading] = ()
    lever_arm_metres: tuple[float, float] | None = (0.0, 0.0)
    prior: SensorOffsets | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Optimised poses with their marginal covariances, and the outliers among the factors.

    Attributes
    ----------
    poses : dict of int to Pose2
        ``map_from_robot`` by frame index.
    covariances : dict of int to (3, 3) float64
        Marginal, of x, y (m), theta (rad), in the robot's own axes.
    switched_off : tuple of int
        Indices of the given links that the others contradict.
    heading_outliers, position_outliers : tuple of int
        Indices of the given readings that the others contradict.
    offsets : SensorOffsets
        Without meaning where there was no reading.
    variance_factor : float
        Factor on the covariances of links between pictures, for the poses' covariances.
    """

    poses: dict[int, Pose2]
    covariances: dict[int, Float64Array]
    switched_off: tuple[int, ...]
    heading_outliers: tuple[int, ...]
    position_outliers: tuple[int, ...]
    offsets: SensorOffsets
    variance_factor: float
