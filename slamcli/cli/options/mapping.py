"""Options of the mapper: registration of frames, keyframes, loop closure."""

from __future__ import annotations

from functools import partial

from slamcli.cli.options.features import feature_kind
from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.sections import FEATURES, MAPPING, expert
from slamcli.cli.options.values import POSITIVE, SHARE, Number, Whole
from slamcli.core.bounds import HALF_TURN_DEGREES, METRES_PER_PIXEL, TILT_DEGREES, Bounds
from slamcli.core.config import MapperOptions

_mapper = partial(option, MapperOptions())
_HALF_TURN = Number(HALF_TURN_DEGREES)

_features = expert(FEATURES, feature_kind(MapperOptions().features))

_mapping = expert(
    MAPPING,
    _mapper(
        "metres_per_pixel",
        "--view-metres-per-pixel",
        Number(METRES_PER_PIXEL),
        "Resolution of the bird's-eye views that are matched. Default: chosen from the camera's "
        "sampling of the floor.",
    ),
    _mapper(
        "recent_keyframes",
        "--recent-keyframes",
        Whole(Bounds(1, 10_000, whole=True)),
        "Number of latest keyframes that a frame is compared with.",
    ),
    _mapper(
        "keyframe_overlap",
        "--keyframe-overlap",
        SHARE,
        "A frame that shares less floor than this with the latest keyframe becomes a keyframe.",
    ),
    _mapper(
        "min_overlap",
        "--min-overlap",
        SHARE,
        "Smallest share of floor in common for a fit to be accepted.",
    ),
    _mapper(
        "max_turn_degrees",
        "--max-turn",
        _HALF_TURN,
        "Degrees: largest turn between two frames that are compared.",
    ),
    _mapper(
        "min_score",
        "--min-score",
        SHARE,
        "Smallest score of a motion, the probability that it is right, for it to be accepted.",
    ),
    _mapper(
        "min_correlation",
        "--min-correlation",
        Number(Bounds(-1, 1)),
        "Smallest correlation of the overlap's pixels for a fit to be accepted.",
    ),
    _mapper(
        "tilt_sigma_degrees",
        "--tilt-sigma",
        Number(TILT_DEGREES),
        "Degrees by which the camera's pitch varies from frame to frame (one standard deviation).",
    ),
    _mapper(
        "dense",
        "--dense/--no-dense",
        text="Search for the motion by correlation of pixels where features do not suffice.",
    ),
    _mapper(
        "search_angle_degrees",
        "--search-angle",
        _HALF_TURN,
        "--dense: degrees of turn to either side that are searched.",
    ),
    _mapper(
        "max_rival_evidence",
        "--max-rival",
        SHARE,
        "A motion is rejected as ambiguous when another one has more than this share of its "
        "evidence.",
    ),
    _mapper(
        "max_step_metres",
        "--max-step",
        POSITIVE,
        "Metres: largest distance from one frame to the next. On a floor with a repeating pattern "
        "give less than half its period, which makes the motion unambiguous.",
    ),
    _mapper(
        "loops",
        "--loops/--no-loops",
        text="Loop closure and relocalisation: recognise floor that was mapped before.",
    ),
    _mapper(
        "refine",
        "--refine-pixels/--no-refine-pixels",
        text="Refine each fit on the pixels themselves (photometric refinement).",
    ),
)

mapper_options = stacked(_features, _mapping)
