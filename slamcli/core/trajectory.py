"""Trajectories, and their errors against a truth."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A trajectory: poses in order of time; frames without a pose are left out.

    Attributes
    ----------
    poses : (N, 3) float64
        ``map_from_robot``: x, y (m), heading (rad, counter-clockwise).
    stamps : (N,) float64 or None
        Seconds; None when any pose has none.
    names : tuple of str or None
        Of the frames; None when any pose has none.
    fragments : (N,) int64
        Which connected map each pose belongs to.
    sigmas : (N, 3) float64 or None
        One standard deviation of x, y (m, along the map's axes) and heading (rad); nan where it
        is not known.
    unplaced : int
        How many frames of the file have no pose.
    headings : (N,) float64 or None
        As the file has them, not within a turn; None where it has none.
    """

    poses: Float64Array
    stamps: Float64Array | None
    names: tuple[str, ...] | None
    fragments: Int64Array
    sigmas: Float64Array | None
    unplaced: int = 0
    headings: Float64Array | None = None

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of the absolute values of errors, in their unit; nan without any.

    Attributes
    ----------
    rmse : float
        Root mean square.
    mean, median, largest : float
    """

    rmse: float
    mean: float
    median: float
    largest: float


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of the sigmas with the errors.

    Attributes
    ----------
    count : int
        Poses with sigmas.
    nees : float
        Mean squared error over variance, added up over x, y and heading: 3 for sigmas of the
        right size, more when they are too small (Bar-Shalom, Li, Kirubarajan, Estimation with
        Applications to Tracking and Navigation, 2001, sec. 5.4).
    within_95_percent : float
        Share of the poses inside their own 95 % bound (chi-squared, 3 degrees of freedom).
    """

    count: int
    nees: float
    within_95_percent: float


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors of one fragment, or of all of them, against the truth.

    Attributes
    ----------
    fragment : int or None
        None for all fragments together, each aligned for itself.
    poses : int
        Compared with the truth.
    path_metres : float
        Length of the truth's path through those poses.
    absolute : Statistics
        ATE: metres between positions, after the best rigid alignment.
    absolute_share_of_path : float
        Its root mean square over the path's length.
    heading : Statistics
        Degrees, after the same alignment.
    relative : Statistics
        RPE: metres, of the motion over `delta` poses.
    relative_heading : Statistics
        Degrees, of the same.
    delta : int
    truth_from_map : Pose2 or None
        The alignment; None for all fragments together.
    consistency : Consistency or None
        None when the poses carry no sigmas.
    """

    fragment: int | None
    poses: int
    path_metres: float
    absolute: Statistics
    absolute_share_of_path: float
    heading: Statistics
    relative: Statistics
    relative_heading: Statistics
    delta: int
    truth_from_map: Pose2 | None
    consistency: Consistency | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result of comparing a whole trajectory with its truth.

    Attributes
    ----------
    matched_by : str
        ``stamps``, ``frame names`` or ``order``.
    matched, truth_poses, unplaced : int
        Poses compared; poses of the truth; frames that the estimate could not place.
    whole : Accuracy
    fragments : tuple of Accuracy
        Those with a pose that the truth knows, by number.
    """

    matched_by: str
    matched: int
    truth_poses: int
    unplaced: int
    whole: Accuracy
    fragments: tuple[Accuracy, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSeries:
    """The errors of one trajectory, pose by pose in the truth's order.

    Attributes
    ----------
    name : str
    fragments : (M,) int64
    path_metres : (M,) float64
        Length of the truth's path up to each pose.
    aligned : (M, 2) float64
        Positions in the truth's axes, metres, every fragment aligned for itself.
    errors_metres, errors_degrees : (M,) float64
        Of position and heading.
    sigmas_metres : (M,) float64
        One standard deviation of the position; nan where it is not known.
    """

    name: str
    fragments: Int64Array
    path_metres: Float64Array
    aligned: Float64Array
    errors_metres: Float64Array
    errors_degrees: Float64Array
    sigmas_metres: Float64Array
