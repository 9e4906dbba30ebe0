"""A simulated world: its camera, what disturbs it, its floor and the way over it."""

from __future__ import annotations

import click

from slamcli.cli.options.common import stacked
from slamcli.cli.options.values import NOT_NEGATIVE, POSITIVE, Size

camera_options = stacked(
    click.option("--size", type=Size(), default="640x480", show_default=True),
    click.option("--height", type=POSITIVE, default=0.3, show_default=True, help="Metres."),
    click.option(
        "--pitch",
        type=click.FloatRange(1, 90),
        default=38.0,
        show_default=True,
        help="Degrees below the horizontal.",
    ),
    click.option(
        "--roll",
        type=click.FloatRange(-45, 45),
        default=0.0,
        show_default=True,
        help="Degrees, right side down.",
    ),
    click.option(
        "--field-of-view",
        type=click.FloatRange(5, 150),
        default=62.0,
        show_default=True,
        help="Degrees across the picture's width.",
    ),
    click.option("--k1", type=float, default=0.0, show_default=True, help="Radial distortion."),
    click.option("--k2", type=float, default=0.0, show_default=True, help="Radial distortion."),
)

disturbance_options = stacked(
    click.option("--noise", type=NOT_NEGATIVE, default=2.0, show_default=True, help="Gray levels."),
    click.option(
        "--motion-blur",
        type=click.FloatRange(0, 1),
        default=0.0,
        show_default=True,
        help="Share of a step that the shutter is open for.",
    ),
    click.option(
        "--flicker",
        type=click.FloatRange(0, 0.95),
        default=0.0,
        show_default=True,
        help="Largest change of exposure, as a share.",
    ),
    click.option(
        "--vignetting",
        type=click.FloatRange(0, 1),
        default=0.15,
        show_default=True,
        help="Share of the brightness lost in the corners.",
    ),
    click.option(
        "--rocking",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Degrees by which pitch and roll vary from frame to frame (one sigma).",
    ),
    click.option(
        "--bounce",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Metres by which the height varies from frame to frame (one sigma).",
    ),
    click.option(
        "--boxes",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Things that stand on the floor along the way; every third one moves.",
    ),
    click.option(
        "--walkers",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help="Pairs of legs that cross the view.",
    ),
)

floor_options = stacked(
    click.option(
        "--floor",
        default="asphalt",
        show_default=True,
        help="asphalt, bare, carpet, concrete, course, planks, terrazzo, tiles, or a picture.",
    ),
    click.option(
        "--floor-metres-per-pixel",
        type=POSITIVE,
        default=0.001,
        show_default=True,
        help="Of a picture given as the floor.",
    ),
    click.option(
        "--wear",
        type=click.FloatRange(0, 1),
        default=0.5,
        show_default=True,
        help="How scuffed the floor is; 0: a course in pure black and white, all tiles alike.",
    ),
    click.option(
        "--room",
        type=NOT_NEGATIVE,
        default=0.0,
        show_default=True,
        help="Metres; side of a square room whose walls the camera sees; 0 is none.",
    ),
)

path_options = stacked(
    click.option(
        "--path",
        default="loop",
        show_default=True,
        help="line, loop, lawnmower, drift, or a CSV of poses with columns x, y, heading.",
    ),
    click.option(
        "--length", type=POSITIVE, default=8.0, show_default=True, help="Metres of the way."
    ),
    click.option("--frames", type=click.IntRange(min=1), default=100, show_default=True),
    click.option("--frame-rate", type=POSITIVE, default=10.0, show_default=True),
    click.option(
        "--lane",
        type=POSITIVE,
        default=0.6,
        show_default=True,
        help="Metres between the lawnmower's lanes.",
    ),
)
