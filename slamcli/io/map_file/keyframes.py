"""The keyframes in a map file: their features, and their views as small pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slamcli.core.arrays import AnyArray
from slamcli.core.bounds import COORDINATE, MAX_POINTS
from slamcli.core.errors import MapError
from slamcli.core.records import DescriptorNorm, Features, Keyframe, PoseEstimate
from slamcli.io.map_file.pose_graph import expect

# Numpy's names of the types; descriptors have one of two.
KEYFRAME_TYPES = {
    "rows": "<i8",
    "points": "<f4",
    "scores": "<f4",
    "sigmas": "<f4",
    "sizes": "<f4",
    "angles": "<f4",
    "descriptors": "",
    "pictures": "|u1",
}
DESCRIPTOR_TYPES = ("|u1", "<f4")
# Markers of the segment that declares a JPEG's size, of the kinds that OpenCV writes or reads.
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2)
_MAX_KEYFRAMES = 2_000_000
_MAX_DESCRIPTOR_LENGTH = 4096
# Of each row: frame index, and how many points, bytes of picture and bytes of mask it has.
_ROW_COLUMNS = 4
# In place of the features of no keyframe at all, so that every array has its type and width.
_NO_FEATURES = Features(
    np.empty((0, 2), np.float32),
    np.empty((0, 1), np.uint8),
    np.empty(0, np.float32),
    np.empty((0, 2), np.float32),
    np.empty(0, np.float32),
    np.empty(0, np.float32),
)


def features_norm(keyframes: Sequence[Keyframe]) -> DescriptorNorm:
    """Return how the descriptors of all keyframes are compared."""
    return (keyframes[0].features if keyframes else _NO_FEATURES).norm


def keyframe_arrays(keyframes: Sequence[Keyframe]) -> dict[str, AnyArray]:
    """Return what `parse_keyframes` reads back."""
    rows = [(k.index, len(k.features), len(k.image), len(k.mask)) for k in keyframes]
    every = [keyframe.features for keyframe in keyframes] or [_NO_FEATURES]
    return {
        "rows": np.array(rows, "<i8").reshape(-1, _ROW_COLUMNS),
        "points": _joined([f.points for f in every], "<f4"),
        "scores": _joined([f.scores for f in every], "<f4"),
        "sigmas": _joined([f.sigmas for f in every], "<f4"),
        "sizes": _joined([f.sizes for f in every], "<f4"),
        "angles": _joined([f.angles for f in every], "<f4"),
        "descriptors": _joined([f.descriptors for f in every], every[0].descriptors.dtype),
        "pictures": np.frombuffer(b"".join(k.image + k.mask for k in keyframes), "|u1"),
    }


def parse_keyframes(
    arrays: Mapping[str, AnyArray],
    norm: DescriptorNorm,
    frames: Mapping[int, PoseEstimate],
    size: tuple[int, int],
) -> tuple[Keyframe, ...]:
    """Return keyframes, each number checked; raises MapError.

    Parameters
    ----------
    size : (int, int)
        Width and height that every picture declares; its pixels are decoded when it is used.
    """
    _check_shapes(arrays, norm)
    _check_numbers(arrays)
    pictures = arrays["pictures"].tobytes()
    keyframes = []
    first_point = first_byte = 0
    for index, count, image_bytes, mask_bytes in arrays["rows"].tolist():
        frame = frames.get(index)
        if frame is None or frame.map_from_robot is None:
            raise MapError(f"its keyframe {index} has no pose")
        mask_start = first_byte + image_bytes
        image = pictures[first_byte:mask_start]
        mask = pictures[mask_start : mask_start + mask_bytes]
        if _declared_size(image) != size or _declared_size(mask) != size:
            raise MapError(f"the pictures of its keyframe {index} are damaged")
        keyframes.append(
            Keyframe(
                index,
                frame.name,
                frame.stamp,
                _features(arrays, slice(first_point, first_point + count), norm),
                image,
                mask,
            )
        )
        first_point, first_byte = first_point + count, mask_start + mask_bytes
    return tuple(keyframes)


def _declared_size(picture: bytes) -> tuple[int, int] | None:
    """Return the width and height in the header of a JPEG or PNG; None where there is none."""
    if picture.startswith(b"\x89PNG\r\n\x1a\n") and len(picture) >= 24:
        return int.from_bytes(picture[16:20], "big"), int.from_bytes(picture[20:24], "big")
    at = 2
    while picture.startswith(b"\xff\xd8\xff") and at + 9 <= len(picture) and picture[at] == 0xFF:
        if picture[at + 1] in _JPEG_FRAMES:
            height, width = picture[at + 5 : at + 7], picture[at + 7 : at + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        at += 2 + int.from_bytes(picture[at + 2 : at + 4], "big")
    return None


def _features(arrays: Mapping[str, AnyArray], points: slice, norm: DescriptorNorm) -> Features:
    """Return the features of one keyframe: some of the points of all."""
    return Features(
        arrays["points"][points],
        arrays["descriptors"][points],
        arrays["scores"][points],
        arrays["sigmas"][points],
        arrays["sizes"][points],
        arrays["angles"][points],
        norm,
    )


def _check_shapes(arrays: Mapping[str, AnyArray], norm: DescriptorNorm) -> None:
    """Refuse arrays that do not fit one another."""
    rows, points = arrays["rows"], arrays["points"]
    count, total = len(rows), len(points)
    expect(arrays, "rows", (count, _ROW_COLUMNS))
    for name in ("points", "sigmas"):
        expect(arrays, name, (total, 2))
    for name in ("scores", "sizes", "angles"):
        expect(arrays, name, (total,))
    shape = arrays["descriptors"].shape
    if len(shape) != 2 or shape[0] != total or not 1 <= shape[1] <= _MAX_DESCRIPTOR_LENGTH:
        raise MapError(f"its descriptors have shape {shape}")
    if norm != "l2" and arrays["descriptors"].dtype != np.uint8:
        raise MapError(f"its descriptors do not suit the norm {norm}")
    if count > _MAX_KEYFRAMES:
        raise MapError(f"it has {count} keyframes")
    if rows.min(initial=0) < 0 or rows.max(initial=0) >= 2**31:
        raise MapError("the numbers of its keyframes are wrong")
    if len(np.unique(rows[:, 0])) != count:
        raise MapError("the numbers of its keyframes are wrong")
    if rows[:, 1].max(initial=0) > MAX_POINTS or rows[:, 1].sum() != total:
        raise MapError("the numbers of its points are wrong")
    if rows[:, 2:4].sum() != len(arrays["pictures"]):
        raise MapError("the lengths of its pictures are wrong")


def _check_numbers(arrays: Mapping[str, AnyArray]) -> None:
    """Refuse numbers that no floor has."""
    for name in ("points", "scores", "sigmas", "sizes", "descriptors"):
        values = arrays[name]
        if values.dtype != np.uint8 and not np.all(np.isfinite(values)):
            raise MapError(f"its {name} have a number that is not finite")
    smallest = min(float(arrays[name].min(initial=1.0)) for name in ("sigmas", "sizes"))
    if np.abs(arrays["points"]).max(initial=0.0) > COORDINATE.high or smallest <= 0.0:
        raise MapError("its points, their sigmas or their sizes are out of range")
    # Points of an upright or a trained kind have no angle: nan.
    if np.isinf(arrays["angles"]).any():
        raise MapError("its angles have a number that is not finite")


def _joined(pieces: Sequence[AnyArray], kind: Any) -> AnyArray:
    return np.concatenate(pieces).astype(np.dtype(kind).newbyteorder("<"), copy=False)
