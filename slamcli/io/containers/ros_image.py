"""ROS images (sensor_msgs/Image and CompressedImage) as pixels or encoded pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array, UInt16Array
from slamcli.core.errors import FrameError
from slamcli.io.images.header import Header

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
# Channels and bits of an encoding, and the conversion to BGR; the names of Bayer patterns are of
# the first two pixels of the first two rows.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 8, None),
    "8UC1": (1, 8, None),
    "mono16": (1, 16, None),
    "16UC1": (1, 16, None),
    "bgr8": (3, 8, None),
    "8UC3": (3, 8, None),
    "rgb8": (3, 8, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 8, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, 8, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 8, cv2.COLOR_RGBA2BGR),
    "bgr16": (3, 16, None),
    "rgb16": (3, 16, cv2.COLOR_RGB2BGR),
    "bgra16": (4, 16, cv2.COLOR_BGRA2BGR),
    "rgba16": (4, 16, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, 8, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, 8, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, 8, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, 8, cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": (1, 16, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr16": (1, 16, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg16": (1, 16, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg16": (1, 16, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, 8, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, 8, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, 8, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, 8, cv2.COLOR_YUV2BGR_YUY2),
}
# Distances, not brightness.
_DEPTHS = frozenset({"16UC1", "32FC1"})


def is_depth(message: Any) -> bool:
    """Return whether a message is no picture but an image of distances."""
    encoding = getattr(message, "encoding", None)
    return encoding in _DEPTHS if encoding is not None else "compressedDepth" in message.format


def used_bits(message: Any) -> int:
    """Return the bits of the largest sample; 8 for a picture of 8 bits; raises FrameError."""
    if getattr(message, "encoding", None) is None:
        return 8
    samples = _samples(message)
    return 8 if samples.dtype == np.uint8 else max(8, int(samples.max()).bit_length())


def picture(message: Any, sample_bits: int) -> bytes | UInt8Array:
    """Return an encoded picture, or (H, W) gray or (H, W, 3) BGR pixels.

    Parameters
    ----------
    sample_bits : int
        The range of samples of 16 bits, of which the upper 8 are kept.

    Raises
    ------
    FrameError
    """
    if getattr(message, "encoding", None) is None:
        return bytes(message.data)
    samples = _samples(message)
    if samples.dtype == np.uint16:
        samples = np.minimum(samples >> (sample_bits - 8), 255).astype(np.uint8)
    code = _ENCODINGS[message.encoding][2]
    pixels = samples if code is None else cv2.cvtColor(samples, code)
    return np.ascontiguousarray(pixels, np.uint8)


def _samples(message: Any) -> UInt8Array | UInt16Array:
    """Return the samples of an image, (H, W) or (H, W, channels); raises FrameError."""
    if message.encoding not in _ENCODINGS:
        raise FrameError(f"a ROS image of encoding {message.encoding[:20]!r} is not read")
    channels, bits, _ = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    Header(width, height, bits)
    data = np.frombuffer(message.data, np.uint8)
    row = width * channels * bits // 8
    if step < row or len(data) < step * (height - 1) + row:
        raise FrameError("damaged: a ROS image with less data than its size needs")
    data = np.pad(data[: step * height], (0, max(0, step * height - len(data))))
    rows = data.reshape(height, step)[:, :row]
    if bits == 8:
        return rows if channels == 1 else rows.reshape(height, width, channels)
    order = ">" if message.is_bigendian else "<"
    wide = np.ascontiguousarray(rows).view(f"{order}u2").astype(np.uint16)
    return wide if channels == 1 else wide.reshape(height, width, channels)
