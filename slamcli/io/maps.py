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
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from slamcli.core.errors import InputError, MapError
from slamcli.core.geometry import Pose2
from slamcli.core.records import (
    DescriptorNorm,
    Features,
    FloorMap,
    Keyframe,
    PoseEstimate,
)
from slamcli.io.files import write_bytes
from slamcli.io.map_headers import (
    MOST_METRES,
    MOST_POINTS,
    calibration_header,
    parse_calibration,
    parse_features,
    parse_number,
    parse_word,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MAP_NAME = "map.slam"
FORMAT_VERSION = 1
_MAGIC = b"slamcli map "
_DIGEST_BYTES = 32
_LENGTH_BYTES = 8
_MOST_BYTES = 16 * 2**30
_MOST_KEYFRAMES = 2_000_000
_KINDS = {
    "rows": "<i8",
    "stamps": "<f8",
    "poses": "<f8",
    "covariances": "<f8",
    "points": "<f4",
    "scores": "<f4",
    "sigmas": "<f4",
    "sizes": "<f4",
    "angles": "<f4",
    "descriptors": "",
    "pictures": "|u1",
    "names": "|u1",
}
# Of each row: index, fragment, and how many points, and bytes of picture, mask and name it has.
_ROW_COLUMNS = 6


def save_map(path: Path, floor_map: FloorMap) -> None:
    """Write a map whole or not at all; `load_map` returns the same."""
    keyframes, estimates = floor_map.keyframes, floor_map.estimates
    names = [keyframe.name.encode() for keyframe in keyframes]
    rows = [
        (
            keyframe.index,
            estimate.fragment,
            len(keyframe.features),
            len(keyframe.image),
            len(keyframe.mask),
            len(name),
        )
        for keyframe, estimate, name in zip(keyframes, estimates, names, strict=True)
    ]
    every = [keyframe.features for keyframe in keyframes]
    poses = [e.map_from_robot for e in estimates if e.map_from_robot is not None]
    covariances = [e.covariance for e in estimates if e.covariance is not None]
    stamps = [math.nan if k.stamp is None else k.stamp for k in keyframes]
    arrays: dict[str, NDArray[Any]] = {
        "rows": np.array(rows, "<i8").reshape(-1, _ROW_COLUMNS),
        "stamps": np.array(stamps, "<f8"),
        "poses": np.array([(p.x, p.y, p.theta) for p in poses], "<f8").reshape(-1, 3),
        "covariances": np.array(covariances, "<f8").reshape(-1, 3, 3),
        "points": _joined([f.points for f in every], "<f4"),
        "scores": _joined([f.scores for f in every], "<f4"),
        "sigmas": _joined([f.sigmas for f in every], "<f4"),
        "sizes": _joined([f.sizes for f in every], "<f4"),
        "angles": _joined([f.angles for f in every], "<f4"),
        "descriptors": _joined([f.descriptors for f in every], every[0].descriptors.dtype),
        "pictures": np.frombuffer(b"".join(k.image + k.mask for k in keyframes), "|u1"),
        "names": np.frombuffer(b"".join(names), "|u1"),
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
        if file.stat().st_size > _MOST_BYTES:
            raise MapError(f"{file} is larger than any map ({_MOST_BYTES >> 30} GB)")
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
    keyframes, estimates = _parse_keyframes(arrays, norm)
    return FloorMap(
        parse_calibration(header["calibration"]),
        features,
        parse_number(header["metres_per_pixel"], "metres_per_pixel", 1e-9, MOST_METRES),
        parse_number(header["tilt_sigma_degrees"], "tilt_sigma_degrees", 0.0, 90.0),
        keyframes,
        estimates,
    )


def _parse_arrays(listed: Any, data: memoryview) -> dict[str, NDArray[Any]]:
    """Cut the arrays out of the data, which they must fill exactly."""
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    for name, known in _KINDS.items():
        kind, shape = listed[name]
        if kind != known and (known or kind not in {"|u1", "<f4"}):
            raise MapError(f"its {name} are of kind {kind!r}")
        if not all(type(n) is int and 0 <= n <= _MOST_BYTES for n in shape) or len(shape) > 3:
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
    arrays: dict[str, NDArray[Any]], norm: DescriptorNorm
) -> tuple[tuple[Keyframe, ...], tuple[PoseEstimate, ...]]:
    _check_shapes(arrays, norm)
    rows, points = arrays["rows"], arrays["points"]
    descriptors = arrays["descriptors"]
    _check_numbers(arrays)
    pictures, names = arrays["pictures"].tobytes(), arrays["names"].tobytes()
    ends = np.cumsum(rows, axis=0)
    keyframes, estimates = [], []
    for place, (index, fragment, held, image_bytes, mask_bytes, name_bytes) in enumerate(
        rows.tolist()
    ):
        mine = slice(int(ends[place, 2]) - held, int(ends[place, 2]))
        picture = int(ends[place, 3] + ends[place, 4]) - image_bytes - mask_bytes
        name_end = int(ends[place, 5])
        name = names[name_end - name_bytes : name_end].decode("utf-8", "replace")
        stamp = float(arrays["stamps"][place])
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
            name,
            None if math.isnan(stamp) else stamp,
            features,
            pictures[picture : picture + image_bytes],
            pictures[picture + image_bytes : picture + image_bytes + mask_bytes],
        )
        keyframes.append(keyframe)
        pose, covariance = Pose2(*arrays["poses"][place].tolist()), arrays["covariances"][place]
        estimates.append(
            PoseEstimate(index, name, keyframe.stamp, pose, "tracked", "", fragment, covariance)
        )
    return tuple(keyframes), tuple(estimates)


def _check_shapes(arrays: dict[str, NDArray[Any]], norm: DescriptorNorm) -> None:
    """Refuse arrays that do not fit one another."""
    rows, points = arrays["rows"], arrays["points"]
    count, total = len(rows), len(points)
    _expect(arrays, "rows", (count, _ROW_COLUMNS))
    for name, shape in (
        ("stamps", (count,)),
        ("poses", (count, 3)),
        ("covariances", (count, 3, 3)),
    ):
        _expect(arrays, name, shape)
    for name in ("points", "sigmas"):
        _expect(arrays, name, (total, 2))
    for name in ("scores", "sizes", "angles"):
        _expect(arrays, name, (total,))
    descriptors = arrays["descriptors"]
    if descriptors.ndim != 2 or len(descriptors) != total or not 1 <= descriptors.shape[1] <= 4096:
        raise MapError(f"its descriptors have shape {descriptors.shape}")
    if norm != "l2" and descriptors.dtype != np.uint8:
        raise MapError(f"its descriptors do not suit the norm {norm}")
    if not 1 <= count <= _MOST_KEYFRAMES:
        raise MapError(f"it has {count} keyframes")
    if rows.min() < 0 or rows.max() >= 2**31 or len(np.unique(rows[:, 0])) != count:
        raise MapError("the numbers of its keyframes are wrong")
    if rows[:, 2].max() > MOST_POINTS or rows[:, 2].sum() != total:
        raise MapError("the numbers of its points are wrong")
    if rows[:, 3:5].sum() != len(arrays["pictures"]) or rows[:, 5].sum() != len(arrays["names"]):
        raise MapError("the lengths of its pictures or names are wrong")


def _expect(arrays: dict[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> None:
    if arrays[name].shape != shape:
        raise MapError(f"its {name} have shape {arrays[name].shape}; {shape} is needed")


def _check_numbers(arrays: dict[str, NDArray[Any]]) -> None:
    """Refuse numbers that no floor has."""
    for name in ("poses", "covariances", "points", "scores", "sigmas", "sizes", "descriptors"):
        values = arrays[name]
        if values.dtype != np.uint8 and not np.all(np.isfinite(values)):
            raise MapError(f"its {name} hold a number that is not finite")
    if np.abs(arrays["poses"][:, :2]).max() > MOST_METRES:
        raise MapError("a pose lies off the Earth")
    points = arrays["points"]
    least = min(float(arrays[name].min(initial=1.0)) for name in ("sigmas", "sizes"))
    if np.abs(points).max(initial=0.0) > MOST_METRES or least <= 0.0:
        raise MapError("its points, their sigmas or their sizes are out of range")
    # Points of an upright or a trained kind have no angle: nan.
    if np.isinf(arrays["angles"]).any():
        raise MapError("its angles hold a number that is not finite")
    covariances = arrays["covariances"]
    symmetric = np.allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-6, atol=1e-12)
    if not symmetric or np.linalg.eigvalsh(covariances).min() < -1e-12:
        raise MapError("a covariance is not one")


def _joined(pieces: Sequence[NDArray[Any]], kind: Any) -> NDArray[Any]:
    return np.concatenate(pieces).astype(np.dtype(kind).newbyteorder("<"), copy=False)
