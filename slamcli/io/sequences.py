"""Sequences of public benchmarks: text files that list pictures, with stamps or true poses.

- HD Ground (Schmid et al., ICRA 2022): a picture's path on each line (``.test``), in files that end
  in ``.txt`` with its true pose.
- PathTex (GroundSLAM): ``image_names.txt`` and ``times.txt`` beside a folder ``rgb``.
- TUM RGB-D: ``rgb.txt``, whose lines are a stamp and a path.
"""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import COORDINATE, STAMP
from slamcli.core.camera.calibration import top_down_calibration
from slamcli.core.errors import FrameError, InputError
from slamcli.core.trajectory import Trajectory
from slamcli.io.files import read_text
from slamcli.io.images.decoding import picture_size, read_bytes
from slamcli.io.picture_files import Listed

_SUFFIXES = frozenset({".test", ".txt"})
_NAMES, _TIMES, _PICTURES = "image_names.txt", "times.txt", "rgb"
_SUFFIX = re.compile(r"\.(?:bmp|jpe?g|pgm|png|ppm|tiff?|webp)(?=[\s,;]|$)", re.IGNORECASE)
# A pose is the rows of a 3 x 3 matrix; one that starts with this was not confirmed.
_POSE_NUMBERS, _UNCONFIRMED = 9, "*"
# Width and height of HD Ground's pictures, where they are not there to be asked.
_HD_GROUND_SIZE = (1600, 1200)
_MAX_SHEAR = 0.01

Lines = Sequence[tuple[int, str]]


def sequence_of(source: Path) -> list[Listed] | None:
    """Return the pictures that a text file lists, or that of a folder; None where there is none.

    Raises
    ------
    InputError
        One line that names the file, and the line of it where there is one.
    """
    path = source / _NAMES if source.is_dir() else source
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return None
    found = [_listed(path, number, line) for number, line in _lines(path)]
    times = path.with_name(_TIMES)
    if path.name != _NAMES or not times.is_file():
        return found
    stamps = [_stamp(times, number, line) for number, line in _lines(times)]
    if len(stamps) != len(found):
        raise InputError(f"{times} has {len(stamps)} stamps for {len(found)} pictures")
    return [Listed(one.path, None, stamp) for one, stamp in zip(found, stamps, strict=True)]


def has_listed_poses(line: str) -> bool:
    """Return whether a line is a picture's path and its pose, as those of HD Ground are."""
    return _pose_words(line) is not None


def listed_poses(path: Path, lines: Lines) -> Trajectory:
    """Return the poses of a file of HD Ground, by the names of its pictures.

    Each is ``map_from_image``: a turn and a shift from a picture's pixels to those of the map,
    whose y points down. They become those of frames without a calibration: see
    `top_down_calibration`.
    Poses that were not confirmed are left out.
    """
    poses, names = list[Float64Array](), list[str]()
    size = _size(path, lines[0][1])
    for number, line in lines:
        words = _pose_words(line)
        if words is None:
            raise InputError(f"{path}, line {number}: a picture and {_POSE_NUMBERS} numbers needed")
        if _UNCONFIRMED not in words:
            poses.append(_pose(path, number, words, size))
            names.append(Path(_picture(line).replace("\\", "/")).name)
    return Trajectory(
        np.array(poses).reshape(-1, 3),
        None,
        tuple(names),
        np.zeros(len(poses), np.int64),
        None,
        len(lines) - len(poses),
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    text = read_text(path, "list of pictures").removeprefix("\ufeff")
    return [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def _listed(path: Path, number: int, line: str) -> Listed:
    """Return the picture of a line, with the stamp before it where there is one."""
    words = line.replace(",", " ").split(maxsplit=1)
    stamped = len(words) == 2 and re.fullmatch(r"\d+\.\d+", words[0]) is not None
    name = _picture(words[1] if stamped else line)
    if not name:
        raise InputError(f"{path}, line {number}: no picture; a list of frames is needed")
    folders = (path.parent, path.parent / _PICTURES, path.parent.parent)
    places = [folder / name.replace("\\", "/") for folder in folders]
    try:
        found = next((place for place in places if _is_file(place)), None)
    except OSError as error:
        raise InputError(f"{path}, line {number}: {error.strerror or error}") from error
    if found is None:
        raise InputError(f"{path}, line {number}: {name} does not exist")
    return Listed(found, None, _stamp(path, number, words[0]) if stamped else None)


def _is_file(path: Path) -> bool:
    """Return whether a file is there; raises OSError, unlike `Path`, where none can be."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return False


def _picture(line: str) -> str:
    line = line.lstrip()
    found = _SUFFIX.search(line, 1)
    return "" if found is None else line[: found.end()]


def _stamp(path: Path, number: int, word: str) -> float:
    try:
        stamp = float(word.split(",")[0])
    except ValueError:
        stamp = math.nan
    if not abs(stamp) <= STAMP.high:
        raise InputError(f"{path}, line {number}: {word} is no stamp in seconds")
    return stamp


def _pose_words(line: str) -> list[str] | None:
    """Return what follows a picture's path, if that is a pose."""
    name = _picture(line)
    words = re.split(r"[\s,;]+", line[line.index(name) + len(name) :].strip(" ,;\t[]"))
    numbers = [word for word in words if word != _UNCONFIRMED]
    is_pose = bool(name) and len(numbers) == _POSE_NUMBERS
    return words if is_pose and all(map(_is_number, numbers)) else None


def _is_number(word: str) -> bool:
    try:
        return abs(float(word)) <= COORDINATE.high
    except ValueError:
        return False


def _pose(path: Path, number: int, words: list[str], size: tuple[int, int]) -> Float64Array:
    """Return x and y of the picture's centre, y up, and the heading of its right side."""
    matrix = np.array([float(word) for word in words]).reshape(3, 3)
    gram = matrix[:2, :2].T @ matrix[:2, :2]
    if np.abs(gram - np.eye(2)).max() > _MAX_SHEAR or np.linalg.det(matrix[:2, :2]) < 0.0:
        raise InputError(f"{path}, line {number}: the pose is not a turn and a shift")
    centre = top_down_calibration(size).camera_matrix[:, 2]
    x, y, _ = matrix @ centre
    return np.array([x, -y, math.atan2(-matrix[1, 0], matrix[0, 0])])


def _size(path: Path, line: str) -> tuple[int, int]:
    """Return the width and height of the pictures, which may not be there with their poses."""
    try:
        return picture_size(read_bytes(_listed(path, 1, line).path))
    except (FrameError, InputError):
        return _HD_GROUND_SIZE
