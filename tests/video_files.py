"""Short videos for tests, written by PyAV."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def write_video(
    path: Path,
    pictures: Sequence[np.ndarray],
    *,
    codec: str = "ffv1",
    pixels: str = "bgr0",
    rate: int = 10,
    stamps: Sequence[float] | None = None,
    turn_degrees: int = 0,
    keyframe_every: int = 4,
) -> Path:
    """Write BGR pictures, without loss by default; stamps are seconds.

    The turn is what a player is to turn the picture by, counter-clockwise.
    """
    units = 1000
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, units)
        stream.codec_context.gop_size = keyframe_every
        if turn_degrees:
            stream.set_display_rotation(turn_degrees)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
            seconds = number / rate if stamps is None else stamps[number]
            frame.pts, frame.time_base = round(seconds * units), Fraction(1, units)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path
