"""map.slam: a finished map in one file that is safe to open, to locate in, to extend, to render.

A line of text that names format and version; the SHA-256 of all that follows; the length of a JSON
header; the header; and the arrays that it lists, little-endian, one after another. Nothing in it is
ever executed or unpacked to a size that the file does not have, and every number is checked before
it is used.

Version 2 has the calibration, every frame's pose and all links; version 3 also has the folders and
files of the frames, and may have no keyframes: a map made with learned features, whose network a
file cannot bring with it, can be rendered but not located in.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any, get_args

import numpy as np

from slamcli.core.arrays import AnyArray
from slamcli.core.bounds import METRES_PER_PIXEL, TILT_DEGREES
from slamcli.core.camera.footprint import (
    MAX_REGISTRATION_PIXELS,
    check_metres_per_pixel,
    compared_grid,
    footprint,
)
from slamcli.core.errors import InputError, MapError
from slamcli.core.records import DescriptorNorm, FloorMap
from slamcli.io import calibration_codec
from slamcli.io.checks import FieldError, check_number, check_word
from slamcli.io.files import fault_of_file, write_bytes
from slamcli.io.map_file.header import (
    datums_header,
    features_header,
    parse_datums,
    parse_features,
    parse_selection,
    parse_sources,
    selection_header,
    sources_header,
)
from slamcli.io.map_file.keyframes import (
    DESCRIPTOR_TYPES,
    KEYFRAME_TYPES,
    features_norm,
    keyframe_arrays,
    parse_keyframes,
)
from slamcli.io.map_file.older_pictures import older_size, resampled
from slamcli.io.map_file.pose_graph import DRIVE_KINDS, drive_arrays, parse_drive

MAP_NAME = "map.slam"
FORMAT_VERSION = 4
_OLDER_VERSIONS = (2, 3)
_MAGIC = b"slamcli map "
_DIGEST_BYTES = 32
_LENGTH_BYTES = 8
_MAX_BYTES = 16 * 2**30
_ARRAY_TYPES = {**DRIVE_KINDS, **KEYFRAME_TYPES}


def save_map(path: Path, floor_map: FloorMap) -> None:
    """Write a map whole or not at all; `load_map` returns the same.

    Of a map made with learned features the keyframes are left out: without the network, which is
    not stored, nothing could be compared with them.
    """
    keyframes = floor_map.keyframes if floor_map.features.network is None else ()
    arrays = {
        **drive_arrays(floor_map.estimates, floor_map.links),
        **keyframe_arrays(keyframes),
    }
    header = {
        "calibration": calibration_codec.to_dict(floor_map.calibration),
        "features": features_header(floor_map.features),
        "metres_per_pixel": floor_map.metres_per_pixel,
        "tilt_sigma_degrees": floor_map.tilt_sigma_degrees,
        "norm": features_norm(keyframes),
        "sources": sources_header(floor_map.sources),
        "selection": selection_header(floor_map.selection),
        "datums": datums_header(floor_map.datums),
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


def map_path(path: Path) -> Path:
    """Return the file of a map that is named by it, or by the folder that it is in."""
    return path / MAP_NAME if path.is_dir() else path


def load_map(path: str | Path, *, for_locating: bool = True) -> FloorMap:
    """Return the map in a file, or in a folder that `slam stitch` wrote.

    Parameters
    ----------
    for_locating : bool
        Refuse a map without keyframes, in which no frame can be located.

    Raises
    ------
    MapError
        One line that names the file and what is wrong with it.
    """
    file = map_path(Path(path))
    version, body = _read_body(file)
    try:
        floor_map = _parse(body, older=version in _OLDER_VERSIONS)
    except (FieldError, MapError) as error:
        raise MapError(f"{file}: {_as_sentence(error)}") from error
    except (InputError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MapError(f"{file} is not a sound map: {' '.join(str(error).split())}") from error
    if for_locating and not floor_map.keyframes:
        raise MapError(
            f"{file} was made with {floor_map.features.method.upper()} features, which a map does "
            "not store: it can be rendered, but no frame can be located in it or added to it; "
            "stitch again with --features orb or sift"
        )
    return floor_map


def _as_sentence(error: Exception) -> str:
    return f"its {error}" if isinstance(error, FieldError) else str(error)


def _read_body(file: Path) -> tuple[int, bytes]:
    """Return the format version, and what the checksum covers, once it is right."""
    try:
        fault = fault_of_file(file, _MAX_BYTES)
        if fault:
            raise MapError(f"cannot read the map {file}: {fault}")
        with file.open("rb") as stream:
            # Of something else, however large, no more is read.
            data = stream.read(len(_MAGIC))
            data += stream.read() if data == _MAGIC else b""
    except OSError as error:
        raise MapError(
            f"cannot read the map {file}: {error.strerror}; slam stitch writes one"
        ) from error
    line = data[: len(_MAGIC) + 12].split(b"\n")[0]
    if not line.startswith(_MAGIC):
        raise MapError(f"{file} is not a map; slam stitch writes one, {MAP_NAME}")
    version = line.removeprefix(_MAGIC).decode("ascii", "replace")
    if version not in map(str, (*_OLDER_VERSIONS, FORMAT_VERSION)):
        raise MapError(
            f"{file} has format version {version}; this slamcli reads {_OLDER_VERSIONS[0]} to "
            f"{FORMAT_VERSION}: stitch the frames again"
        )
    start = len(line) + 1
    digest, body = data[start : start + _DIGEST_BYTES], data[start + _DIGEST_BYTES :]
    if hashlib.sha256(body).digest() != digest:
        raise MapError(f"{file} is damaged: its checksum differs; copy or stitch it again")
    return int(version), body


def _parse(body: bytes, *, older: bool) -> FloorMap:
    length = int.from_bytes(body[:_LENGTH_BYTES], "little")
    end = _LENGTH_BYTES + length
    if end > len(body):
        raise MapError("its header is cut off")
    header = json.loads(body[_LENGTH_BYTES:end])
    if not isinstance(header, dict):
        raise MapError("its header is no table")
    features = parse_features(header["features"])
    norm = check_word(header["norm"], "norm", get_args(DescriptorNorm))
    scale, tilt = header["metres_per_pixel"], header["tilt_sigma_degrees"]
    arrays = _parse_arrays(header["arrays"], memoryview(body)[end:])
    estimates, links = parse_drive(arrays)
    calibration = calibration_codec.from_dict(header["calibration"])
    scale = check_number(scale, "metres_per_pixel", METRES_PER_PIXEL)
    check_metres_per_pixel(calibration, scale, MAX_REGISTRATION_PIXELS)
    view, compared = footprint(calibration, scale), compared_grid(calibration, scale)
    size = older_size(view) if older else (compared.width, compared.height)
    keyframes = parse_keyframes(arrays, norm, {e.index: e for e in estimates}, size)
    if older:
        keyframes = tuple(resampled(keyframe, view, compared) for keyframe in keyframes)
    return FloorMap(
        calibration,
        features,
        scale,
        check_number(tilt, "tilt_sigma_degrees", TILT_DEGREES),
        keyframes,
        estimates,
        links,
        parse_sources(header.get("sources", [])),
        parse_selection(header.get("selection", {})),
        parse_datums(header.get("datums", [])),
    )


def _parse_arrays(listed: Any, data: memoryview) -> dict[str, AnyArray]:
    """Cut the arrays out of the data, which they must fill exactly."""
    arrays: dict[str, AnyArray] = {}
    at = 0
    for name, known in _ARRAY_TYPES.items():
        kind, shape = listed[name]
        if kind != known and (known or kind not in DESCRIPTOR_TYPES):
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
