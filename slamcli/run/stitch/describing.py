"""Frames described for a survey: the features of each, or why it has none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.images.canvas import canvas_scale
from slamcli.survey import SurveyFeatures, survey_features


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """A frame's features, or why it has none, and the digest of its file."""

    features: SurveyFeatures | None
    reason: str = ""
    digest: bytes = b""


def describe_file(file: FrameFile) -> Described:
    """Return a frame's features."""
    try:
        frame = read_frame(file, gray=True)
    except FrameError as error:
        return Described(None, str(error))
    return Described(survey_features(frame.image, frame.mask), digest=frame.digest)


def on_canvas(one: Described, canvas: tuple[int, int]) -> SurveyFeatures:
    """Return features in pixels of the canvas; none for a frame that cannot be used."""
    if one.features is None:
        return survey_features(np.zeros((canvas[1], canvas[0]), np.uint8))
    if one.features.size == canvas:
        return one.features
    scale = canvas_scale(one.features.size, canvas)
    size = round(scale * one.features.size[0]), round(scale * one.features.size[1])
    return replace(one.features, size=size, pixels=scale * one.features.pixels)
