"""Frames described for a survey: the features of each, or why it has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.images.canvas import canvas_scale
from slamcli.run.session.session import Session
from slamcli.survey import SurveyFeatures, survey_features
from slamcli.survey.ideal_picture import IdealPicture
from slamcli.survey.slanted import slanted_features


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """A frame's features, or why it has none, and the digest of its file."""

    features: SurveyFeatures | None
    reason: str = ""
    digest: bytes = b""


def describe_file(file: FrameFile, ideal: IdealPicture | None = None) -> Described:
    """Return a frame's features; of its ideal picture where the camera is known."""
    try:
        frame = read_frame(file, gray=True)
    except FrameError as error:
        return Described(None, str(error))
    image, mask = frame.image, frame.mask
    if ideal is not None:
        if image.shape != ideal.usable.shape:
            return Described(None, "of another size than the lens is known for", frame.digest)
        image, mask = ideal.of(image, mask)
    return Described(survey_features(image, mask), digest=frame.digest)


def describe_slanted(file: FrameFile) -> list[SurveyFeatures]:
    """Return the features of tilted views of a frame, on its canvas; none if it cannot be read."""
    try:
        frame = read_frame(file, gray=True)
    except FrameError:
        return []
    return slanted_features(frame.image, frame.mask)


def describe_frames(
    files: Sequence[FrameFile], session: Session, ideal: IdealPicture | None = None
) -> tuple[list[Described], tuple[str, ...]]:
    """Return the features of all frames, and the names of those that vanished meanwhile."""
    described, vanished = list[Described](), list[str]()
    missing = {file.index for file in files if not file.path.exists()}
    work = partial(describe_file, ideal=ideal)
    stage = session.on_this_machine().stage("describing", work, files)
    for file, one in zip(files, stage, strict=False):
        described.append(one)
        if not one.digest and file.index not in missing and not file.path.exists():
            vanished.append(file.name)
        if session.interruption.stops_here():
            break
    return described, tuple(vanished)


def on_canvas(one: Described, canvas: tuple[int, int]) -> SurveyFeatures:
    """Return features in pixels of the canvas; none for a frame that cannot be used."""
    if one.features is None:
        return survey_features(np.zeros((canvas[1], canvas[0]), np.uint8))
    if one.features.size == canvas:
        return one.features
    scale = canvas_scale(one.features.size, canvas)
    size = round(scale * one.features.size[0]), round(scale * one.features.size[1])
    return replace(one.features, size=size, pixels=scale * one.features.pixels)
