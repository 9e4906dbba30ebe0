"""map.slam: what it takes to find oneself in a finished map, in one file that is safe to open.

A line of text that names format and version; the SHA-256 of all that follows; the length of a JSON
header; the header; and the arrays that it lists, little-endian, one after another. Nothing in it is
ever executed or unpacked to a size that the file does not have, and every number is checked before
it is used.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np

from slamcli.core.arrays import AnyArray
from slamcli.core.errors import InputError, MapError
from slamcli.core.records import (
    DescriptorNorm,
    Features,
    FloorMap,
    Keyframe,
    PoseEstimate,
)
from slamcli.io.files import write_bytes
from slamcli.io.map_file.header import (
    MAX_METRES,
    MAX_POINTS,
    calibration_header,
    parse_calibration,
    parse_features,
    parse_number,
    parse_word,
)
from slamcli.io.map_file.pose_graph import DRIVE_KINDS, drive_arrays, expect, parse_drive

MAP_NAME = "map.slam"
FORMAT_VERSION = 2
_MAGIC = b"slamcli map "
_DIGEST_BYTES = 32
_LENGTH_BYTES = 8
_MAX_BYTES = 16 * 2**30
_MAX_KEYFRAMES = 2_000_000
_KINDS = {
    **DRIVE_KINDS,
    "rows": "<i8",
    "points": "<f4",
    "scores": "<f4",
    "sigmas": "<f4",
    "sizes": "<f4",
    "angles": "<f4",
    "descriptors": "",
    "pictures": "|u1",
}
# Of each row: index, and how many points, and bytes of picture and mask it has.
_ROW_COLUMNS = 4


def save_map(path: Path, floor_map: FloorMap) -> None:
    """Write a map whole or not at all; `load_map` returns the same."""
    keyframes = floor_map.keyframes
    rows = [(k.index, len(k.features), len(k.image), len(k.mask)) for k in keyframes]
    every = [keyframe.features for keyframe in keyframes]
    arrays: dict[str, AnyArray] = {
        **drive_arrays(floor_map.estimates, floor_map.links),
        "rows": np.array(rows, "<i8").reshape(-1, _ROW_COLUMNS),
        "points": _joined([f.points for f in every], "<f4"),
        "scores": _joined([f.scores for f in every], "<f4"),
        "sigmas": _joined([f.sigmas for f in every], "<f4"),
        "sizes": _joined([f.sizes for f in every], "<f4"),
        "angles": _joined([f.angles for f in every], "<f4"),
        "descriptors": _joined([f.descriptors for f in every], every[0].descriptors.dtype),
        "pictures": np.frombuffer(b"".join(k.image + k.mask for k in keyframes), "|u1"),
    }
    header = {
        "calibration": calibration_header(floor_map.calibration),
        "features": asdict(floor_map.features),
        "metres_per_pixel": floor_map.metres_per_pixel,
        "tilt_sigma_degrees": floor_map.tilt_sigma_degrees,
        "norm": every[0].norm,
        "arrays": {name: [a.dtype.str, list(a.shape)] for name, a in arrays.items()},
    }
    text = json.dumps(header, sort_keys=True, allow_nan=False).encode()
    body = b"".join(
        [
            len(text).to_bytes(_LENGTH_BYTES, "little"),
            text,
            *(array.tobytes() for array in arrays.values()),
        ]
    )
    first_line = _MAGIC + str(FORMAT_VERSION).encode() + b"\n"
    write_bytes(path, first_line + hashlib.sha256(body).digest() + body)


def load_map(path: str | Path) -> FloorMap:
    """Return the map in a file, or in a folder that `slam stitch` wrote.

    Raises
    ------
    MapError
        One line that names the file and what is wrong with it.
    """
    path = Path(path)
    file = path / MAP_NAME if path.is_dir() else path
    body = _read_body(file)
    try:
        return _parse(body)
    except MapError as error:
        raise MapError(f"{file}: {error}") from error
    except (InputError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MapError(f"{file} is not a sound map: {' '.join(str(error).split())}") from error


def _read_body(file: Path) -> bytes:
    """Return what the checksum covers, once it is right."""
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise MapError(f"{file} is larger than any map ({_MAX_BYTES >> 30} GB)")
        data = file.read_bytes()
    except OSError as error:
        raise MapError(
            f"cannot read the map {file}: {error.strerror}; slam stitch writes one"
        ) from error
    line = data[: len(_MAGIC) + 12].split(b"\n")[0]
    if not line.startswith(_MAGIC):
        raise MapError(f"{file} is not a map; slam stitch writes one, {MAP_NAME}")
    version = line.removeprefix(_MAGIC).decode("ascii", "replace")
    if version != str(FORMAT_VERSION):
        raise MapError(
            f"{file} has format version {version}; this slamcli reads {FORMAT_VERSION}: "
            "stitch the frames again"
        )
    start = len(line) + 1
    digest, body = data[start : start + _DIGEST_BYTES], data[start + _DIGEST_BYTES :]
    if hashlib.sha256(body).digest() != digest:
        raise MapError(f"{file} is damaged: its checksum differs; copy or stitch it again")
    return body


def _parse(body: bytes) -> FloorMap:
    length = int.from_bytes(body[:_LENGTH_BYTES], "little")
    end = _LENGTH_BYTES + length
    if end > len(body):
        raise MapError("its header is cut off")
    header = json.loads(body[_LENGTH_BYTES:end])
    if not isinstance(header, dict):
        raise MapError("its header is no table")
    features = parse_features(header["features"])
    norm = parse_word(header["norm"], get_args(DescriptorNorm), "norm")
    arrays = _parse_arrays(header["arrays"], memoryview(body)[end:])
    estimates, links = parse_drive(arrays)
    keyframes = _parse_keyframes(arrays, norm, {e.index: e for e in estimates})
    return FloorMap(
        parse_calibration(header["calibration"]),
        features,
        parse_number(header["metres_per_pixel"], "metres_per_pixel", 1e-9, MAX_METRES),
        parse_number(header["tilt_sigma_degrees"], "tilt_sigma_degrees", 0.0, 90.0),
        keyframes,
        estimates,
        links,
    )


def _parse_arrays(listed: Any, data: memoryview) -> dict[str, AnyArray]:
    """Cut the arrays out of the data, which they must fill exactly."""
    arrays: dict[str, AnyArray] = {}
    at = 0
    for name, known in _KINDS.items():
        kind, shape = listed[name]
        if kind != known and (known or kind not in {"|u1", "<f4"}):
            raise MapError(f"its {name} are of kind {kind!r}")
        if not all(type(n) is int and 0 <= n <= _MAX_BYTES for n in shape) or len(shape) > 3:
            raise MapError(f"its {name} have shape {shape}")
        count = math.prod(shape)
        size = count * np.dtype(kind).itemsize
        if at + size > len(data):
            raise MapError(f"its {name} are cut off")
        arrays[name] = np.frombuffer(data, kind, count, at).reshape(shape)
        at += size
    if at != len(data):
        raise MapError("it goes on after its end")
    return arrays


def _parse_keyframes(
    arrays: dict[str, AnyArray], norm: DescriptorNorm, frames: Mapping[int, PoseEstimate]
) -> tuple[Keyframe, ...]:
    _check_shapes(arrays, norm)
    rows, points = arrays["rows"], arrays["points"]
    descriptors = arrays["descriptors"]
    _check_numbers(arrays)
    pictures = arrays["pictures"].tobytes()
    ends = np.cumsum(rows, axis=0)
    keyframes = []
    for place, (index, held, image_bytes, mask_bytes) in enumerate(rows.tolist()):
        frame = frames.get(index)
        if frame is None or frame.map_from_robot is None:
            raise MapError(f"its keyframe {index} has no pose")
        mine = slice(int(ends[place, 1]) - held, int(ends[place, 1]))
        picture = int(ends[place, 2] + ends[place, 3]) - image_bytes - mask_bytes
        features = Features(
            points[mine],
            descriptors[mine],
            arrays["scores"][mine],
            arrays["sigmas"][mine],
            arrays["sizes"][mine],
            arrays["angles"][mine],
            norm,
        )
        keyframe = Keyframe(
            index,
            frame.name,
            frame.stamp,
            features,
            pictures[picture : picture + image_bytes],
            pictures[picture + image_bytes : picture + image_bytes + mask_bytes],
        )
        keyframes.append(keyframe)
    return tuple(keyframes)


def _check_shapes(arrays: dict[str, AnyArray], norm: DescriptorNorm) -> None:
    """Refuse arrays that do not fit one another."""
    rows, points = arrays["rows"], arrays["points"]
    count, total = len(rows), len(points)
    expect(arrays, "rows", (count, _ROW_COLUMNS))
    for name in ("points", "sigmas"):
        expect(arrays, name, (total, 2))
    for name in ("scores", "sizes", "angles"):
        expect(arrays, name, (total,))
    descriptors = arrays["descriptors"]
    if descriptors.ndim != 2 or len(descriptors) != total or not 1 <= descriptors.shape[1] <= 4096:
        raise MapError(f"its descriptors have shape {descriptors.shape}")
    if norm != "l2" and descriptors.dtype != np.uint8:
        raise MapError(f"its descriptors do not suit the norm {norm}")
    if not 1 <= count <= _MAX_KEYFRAMES:
        raise MapError(f"it has {count} keyframes")
    if rows.min() < 0 or rows.max() >= 2**31 or len(np.unique(rows[:, 0])) != count:
        raise MapError("the numbers of its keyframes are wrong")
    if rows[:, 1].max() > MAX_POINTS or rows[:, 1].sum() != total:
        raise MapError("the numbers of its points are wrong")
    if rows[:, 2:4].sum() != len(arrays["pictures"]):
        raise MapError("the lengths of its pictures are wrong")


def _check_numbers(arrays: dict[str, AnyArray]) -> None:
    """Refuse numbers that no floor has."""
    for name in ("points", "scores", "sigmas", "sizes", "descriptors"):
        values = arrays[name]
        if values.dtype != np.uint8 and not np.all(np.isfinite(values)):
            raise MapError(f"its {name} hold a number that is not finite")
    points = arrays["points"]
    least = min(float(arrays[name].min(initial=1.0)) for name in ("sigmas", "sizes"))
    if np.abs(points).max(initial=0.0) > MAX_METRES or least <= 0.0:
        raise MapError("its points, their sigmas or their sizes are out of range")
    # Points of an upright or a trained kind have no angle: nan.
    if np.isinf(arrays["angles"]).any():
        raise MapError("its angles hold a number that is not finite")


def _joined(pieces: Sequence[AnyArray], kind: Any) -> AnyArray:
    return np.concatenate(pieces).astype(np.dtype(kind).newbyteorder("<"), copy=False)
