"""Options of the mapper."""

from __future__ import annotations

from dataclasses import dataclass, field

from slamcli.core.config.registration import FeatureOptions, MatchOptions


@dataclass(frozen=True, slots=True)
class MapperOptions:
    """Options of the mapper: registration of frames, keyframes, loop closure.

    Attributes
    ----------
    features, matching
        The model is always rigid.
    metres_per_pixel : float or None
        Resolution of the views that are matched; None chooses it from the camera's sampling.
    recent_keyframes : int
        Number of latest keyframes that a frame is compared with.
    keyframe_overlap : float
        A frame that shares less of its floor with the current keyframe becomes a keyframe.
    min_overlap : float
        Smallest share of floor in common for a fit to be accepted.
    max_turn_degrees : float
        Largest turn between two frames that are compared: floors with lines and squares look the
        same again after a quarter or half turn.
    min_score : float
        Smallest probability that a motion is right for it to be accepted, in [0, 1].
    min_score_alone : float
        The same where too few patches are informative, and neither many features nor what is known
        beforehand support the motion
        [benchmarks/courses.py: wrong ones to 0.83, right ones from 0.87 on].
    min_correlation : float
        Smallest correlation of the overlap's pixels for a fit to be accepted, in [-1, 1].
    tilt_sigma_degrees : float
        Standard deviation of the camera's pitch from frame to frame.
    refine : bool
        Refine each fit on the pixels themselves (photometric refinement).
    dense : bool
        Search for the motion by correlation of pixels where features do not suffice.
    search_angle_degrees : float
        Largest turn to either side in that search.
    search_share_of_range : float
        Radius of that search around the motion model's prediction, as a share of the camera's
        range.
    min_dense_score : float
        Smallest correlation of the overlap's detail for a searched motion to be accepted.
    max_rival_evidence : float
        Largest evidence for another motion, as a share of that for the best one.
    max_sigma_share : float
        Largest sigma of a searched motion, in any direction, as a share of the camera's range.
    max_step_metres : float or None
        Largest distance between two consecutive frames. On a floor with a repeating pattern, less
        than half its period makes the motion unambiguous. None: unknown.
    max_hypotheses : int
        Motions of a search that are followed to the finest pyramid level.
    convincing_inliers : int
    convincing_score : float
        A fit with at least this many inliers and this correlation needs no search.
    loops : bool
        Recognise floor that was mapped before: loop closure and relocalisation.
    """

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(count=1000))
    matching: MatchOptions = field(default_factory=MatchOptions)
    metres_per_pixel: float | None = None
    recent_keyframes: int = 5
    keyframe_overlap: float = 0.7
    min_overlap: float = 0.1
    max_turn_degrees: float = 75.0
    # Right motions over a bare floor under noise score 0.3 to 0.5 [benchmarks/score.py: bare 1].
    min_score: float = 0.25
    min_score_alone: float = 0.9
    min_correlation: float = 0.3
    tilt_sigma_degrees: float = 0.1
    refine: bool = True
    dense: bool = True
    search_angle_degrees: float = 40.0
    search_share_of_range: float = 0.25
    min_dense_score: float = 0.45
    max_rival_evidence: float = 0.75
    max_sigma_share: float = 0.007
    max_step_metres: float | None = None
    max_hypotheses: int = 3
    convincing_inliers: int = 120
    convincing_score: float = 0.5
    loops: bool = True
