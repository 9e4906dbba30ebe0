"""What goes into a pose graph besides links, and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2


@dataclass(frozen=True, slots=True)
class HeadingReading:
    """A compass's reading, tied to a frame.

    Attributes
    ----------
    frame : int
    frame_from_robot : Pose2
        From the frame to the moment of the reading.
    heading_radians : float
        Counter-clockwise from the compass's own zero.
    sigma_radians : float
    share : float
        What it counts beside a reading that errs independently of all others.
    """

    frame: int
    frame_from_robot: Pose2
    heading_radians: float
    sigma_radians: float
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class PositionReading:
    """A GPS reading, tied to a frame.

    Attributes
    ----------
    frame : int
    frame_from_robot : Pose2
        From the frame to the moment of the reading.
    east_metres, north_metres : float
        Of the datum.
    sigma_metres : float
    share : float
        What it counts beside a reading that errs independently of all others.
    """

    frame: int
    frame_from_robot: Pose2
    east_metres: float
    north_metres: float
    sigma_metres: float
    share: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SensorOffsets:
    """What the other senses' readings are off by.

    Attributes
    ----------
    compass_offset_radians, compass_offset_sigma_radians : float
        The compass's heading less that in the map.
    east_north_from_map : Pose2
    east_north_covariance : (3, 3) float64
        Of it: x, y (m), theta (rad), in the map's axes.
    lever_arm_metres : (float, float)
        Of the GPS antenna, ahead and to the left.
    """

    compass_offset_radians: float
    compass_offset_sigma_radians: float
    east_north_from_map: Pose2
    east_north_covariance: Float64Array
    lever_arm_metres: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solved poses.

    Attributes
    ----------
    poses : dict of int to Pose2
        ``map_from_robot`` by frame index.
    covariances : dict of int to (3, 3) float64
        Marginal, of x, y (m), theta (rad), in the robot's own axes.
    switched_off : tuple of int
        Places in the given links of those that the others contradict.
    headings_off, places_off : tuple of int
        The same of the compass's and the GPS's readings.
    offsets : SensorOffsets
        Without meaning where there was no reading.
    variance_factor : float
        What the covariances of links between pictures were multiplied by for the poses' ones.
    """

    poses: dict[int, Pose2]
    covariances: dict[int, Float64Array]
    switched_off: tuple[int, ...]
    headings_off: tuple[int, ...]
    places_off: tuple[int, ...]
    offsets: SensorOffsets
    variance_factor: float
