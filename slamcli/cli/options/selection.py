"""Options that select the frames of videos."""

from __future__ import annotations

from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.sections import CAMERA, expert, section
from slamcli.cli.options.values import Number
from slamcli.core.bounds import HERTZ, SECONDS_OR_ZERO, TIME_STEP
from slamcli.core.config import FrameSelection

_SELECTION = FrameSelection()

_every = section(
    CAMERA,
    option(
        _SELECTION,
        "every_seconds",
        "--every",
        Number(TIME_STEP),
        "Video, bag: seconds between two frames. The sharpest frame of each interval is taken; "
        "default: 0.1.",
    ),
    option(
        _SELECTION,
        "topic",
        "--topic",
        text="Bag: topic of the frames. Default: the only one that has pictures.",
        metavar="NAME",
    ),
)

_details = expert(
    CAMERA,
    option(
        _SELECTION,
        "frames_per_second",
        "--fps",
        Number(HERTZ),
        "The same as --every, as frames per second.",
    ),
    option(
        _SELECTION,
        "from_seconds",
        "--from",
        Number(SECONDS_OR_ZERO),
        "Seconds of a video or a bag before the first frame that is used.",
    ),
    option(
        _SELECTION,
        "to_seconds",
        "--to",
        Number(SECONDS_OR_ZERO),
        "Seconds of a video or a bag up to the last frame that is used.",
    ),
)

selection_options = stacked(_every, _details)
