"""Trajectory files: poses.csv, truth.csv and any CSV with a header, TUM and KITTI."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.bounds import COORDINATE, SIGMA_METRES, STAMP, Bounds
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.trajectory import Trajectory
from slamcli.io.csv_table import HEADINGS, Table, parse_table
from slamcli.io.files import read_text, write_text
from slamcli.io.sequences import has_listed_poses, listed_poses

# What a folder may stand for: a run's poses, a simulation's truth, that of a benchmark's sequence.
_OF_FOLDER = ("poses.csv", "truth.csv", "groundtruth*.txt")
_TUM_FIELDS, _KITTI_FIELDS = 8, 12
_X, _Y = (
    (
        *(axis, f"p{axis}", f"t{axis}", f"pos_{axis}", f"{axis}_pos", f"pose_{axis}"),
        *(f"odom_{axis}", f"position_{axis}", f"position.{axis}", f"pose.{axis}"),
        *(f"pose.position.{axis}", f"pose.pose.position.{axis}"),
    )
    for axis in "xy"
)
# Of a quaternion, each by the names of several loggers.
_QUATERNION = tuple(
    (
        f"q{axis}",
        f"q_{axis}",
        f"orientation_{axis}",
        f"orientation.{axis}",
        f"pose.orientation.{axis}",
        f"pose.pose.orientation.{axis}",
    )
    for axis in "xyzw"
)
_NAMES = ("frame", "name", "file", "filename")
_SIGMAS = (("sigma_x",), ("sigma_y",), ("sigma_heading", "sigma_theta", "sigma_yaw"))
# A robot on a floor leans less than this; more means that z does not point up.
_MAX_LEAN_DEGREES = 15.0
_UNIT = Bounds(-1.001, 1.001)
_FRAGMENT = Bounds(-1, 2**31)
# Of positions and of headings; a pose that is equal to another by definition has none.
_SIGMA = Bounds(0.0, SIGMA_METRES.high)


def read_trajectory(path: Path) -> Trajectory:
    """Return the poses of a file, whose format is found from its content.

    - CSV with a header and the columns x, y (m), heading (rad; or heading_degrees); stamp, frame,
      fragment and sigma_x, sigma_y, sigma_heading are optional. Rows without x are frames without
      a pose. poses.csv and truth.csv are such files.
    - TUM: eight numbers a line, stamp, x, y, z, and a quaternion x, y, z, w.
    - KITTI: twelve numbers a line, the upper three rows of a pose's matrix.
    - HD Ground: a picture's path and nine numbers a line: see `sequences`.

    A folder stands for the file of poses in it: that of a run of `slam stitch`, of a drive of
    `slam simulate`, or the ground truth of TUM's benchmarks and those like them. In TUM and KITTI
    files z must point up from the floor.

    Raises
    ------
    InputError
        One line that names the file, and the line of it where there is one.
    """
    path = poses_file(path)
    text = read_text(path, "poses").removeprefix("\ufeff")
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InputError(f"{path} is empty; poses are needed")
    first = lines[0][1].replace(",", " ").split()
    if not _is_number(first[0]):
        if has_listed_poses(lines[0][1]):
            return listed_poses(path, lines)
        return _from_table(parse_table(path, text))
    if len(first) not in {_TUM_FIELDS, _KITTI_FIELDS} and text.lstrip().startswith("#"):
        return _from_table(parse_table(path, text))
    if len(first) not in {_TUM_FIELDS, _KITTI_FIELDS}:
        raise InputError(
            f"{path}, line {lines[0][0]}: {len(first)} fields without a header; needed is a CSV "
            f"with a header, {_TUM_FIELDS} numbers (TUM) or {_KITTI_FIELDS} (KITTI)"
        )
    numbers = _parse_rows(path, lines, len(first))
    if len(first) == _TUM_FIELDS:
        return _plain(_poses_of_quaternions(path, numbers[:, 1:], lines), numbers[:, 0])
    return _plain(_poses_of_matrices(path, numbers.reshape(-1, 3, 4), lines), None)


def poses_file(path: Path) -> Path:
    """Return a file of poses, that of a folder in its place; raises InputError without just one."""
    if not path.is_dir():
        return path
    found = sorted(file for name in _OF_FOLDER for file in path.glob(name))
    if len(found) == 1:
        return found[0]
    if found:
        names = " and ".join(file.name for file in found)
        raise InputError(f"{path} has several files of poses, {names}; name one of them")
    raise InputError(f"{path} has no file of poses: {', '.join(_OF_FOLDER)}")


def read_path(path: Path) -> list[Pose2]:
    """Return the poses alone of any file that `read_trajectory` reads."""
    return [Pose2(*map(float, row)) for row in read_trajectory(path).poses]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _from_table(table: Table) -> Trajectory:
    x = table.lengths(_X, COORDINATE, blank=True)
    y = table.lengths(_Y, COORDINATE, blank=True)
    heading = _headings(table)
    placed = ~np.isnan(x)
    broken = placed & (np.isnan(y) | np.isnan(heading))
    if broken.any():
        line = table.lines[int(np.argmax(broken))]
        raise InputError(f"{table.path}, line {line}: x, y, heading must be numbers")
    theta = (heading[placed] + math.pi) % math.tau - math.pi
    fragments = np.zeros(len(table))
    if table.has(("fragment",)):
        fragments = np.nan_to_num(table.numbers(("fragment",), _FRAGMENT, blank=True))
    sigmas = None
    if all(table.has(names) for names in _SIGMAS):
        columns = [table.numbers(names, _SIGMA, blank=True)[placed] for names in _SIGMAS]
        sigmas = np.column_stack(columns)
    return Trajectory(
        np.column_stack([x[placed], y[placed], theta]),
        _stamps(table, placed),
        _names(table, placed),
        fragments[placed].astype(np.int64),
        None if sigmas is None or np.isnan(sigmas).all() else sigmas,
        int((~placed).sum()),
        heading[placed],
    )


def _headings(table: Table) -> Float64Array:
    """Return the headings, radians; those of quaternions where there is no column of headings."""
    if table.has_angles(HEADINGS) or not all(table.has(names) for names in _QUATERNION):
        return table.angles(HEADINGS, blank=True)
    x, y, z, w = (table.numbers(names, _UNIT, blank=True) for names in _QUATERNION)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _stamps(table: Table, placed: BoolArray) -> Float64Array | None:
    stamps = table.stamps(STAMP, blank=True)
    return None if stamps is None or np.isnan(stamps[placed]).any() else stamps[placed]


def _names(table: Table, placed: BoolArray) -> tuple[str, ...] | None:
    if not table.has(_NAMES):
        return None
    names = np.array(_distinct(table.words(_NAMES)), dtype=object)[placed]
    return tuple(names) if all(names) else None


def _distinct(names: Sequence[str]) -> list[str]:
    """Return names with their place among equal ones, as frames of several folders have them.

    Those of two files then match in order where both have equally many, and else not at all.
    """
    counts, seen = Counter(names), Counter[str]()
    distinct = []
    for name in names:
        seen[name] += 1
        is_alone = counts[name] == 1 or not name
        distinct.append(name if is_alone else f"{name} ({seen[name]} of {counts[name]})")
    return distinct


def _parse_rows(path: Path, lines: list[tuple[int, str]], width: int) -> Float64Array:
    """Return (N, width) finite numbers; raises InputError that names the line."""
    rows = []
    for number, line in lines:
        words = line.replace(",", " ").split()
        if len(words) != width or not all(map(_is_number, words)):
            raise InputError(f"{path}, line {number}: {width} numbers are needed")
        rows.append([float(word) for word in words])
    matrix = np.array(rows)
    limits = np.full(width, COORDINATE.high)
    if width == _TUM_FIELDS:
        limits[0] = STAMP.high
    inside = (np.abs(matrix) <= limits).all(axis=1)
    if not inside.all():
        number = lines[int(np.argmin(inside))][0]
        raise InputError(f"{path}, line {number}: a number is not finite, or beyond any floor")
    return matrix


def _poses_of_quaternions(
    path: Path, numbers: Float64Array, lines: list[tuple[int, str]]
) -> Float64Array:
    norms = np.linalg.norm(numbers[:, 3:], axis=1)
    if np.any(np.abs(norms - 1.0) > 0.01):
        number = lines[int(np.argmax(np.abs(norms - 1.0)))][0]
        raise InputError(f"{path}, line {number}: the quaternion is not of length 1")
    x, y, z, w = numbers[:, 3:].T / norms
    up = 1.0 - 2.0 * (x * x + y * y)
    _refuse_lean(path, up, lines)
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([numbers[:, :2], yaw])


def _poses_of_matrices(
    path: Path, matrices: Float64Array, lines: list[tuple[int, str]]
) -> Float64Array:
    _refuse_lean(path, matrices[:, 2, 2], lines)
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.column_stack([matrices[:, :2, 3], yaw])


def _refuse_lean(path: Path, up: Float64Array, lines: list[tuple[int, str]]) -> None:
    leaning = up < math.cos(math.radians(_MAX_LEAN_DEGREES))
    if leaning.any():
        number = lines[int(np.argmax(leaning))][0]
        raise InputError(
            f"{path}, line {number}: the pose leans by more than {_MAX_LEAN_DEGREES:g} degrees; "
            "z must point up from the floor"
        )


def _plain(poses: Float64Array, stamps: Float64Array | None) -> Trajectory:
    return Trajectory(poses, stamps, None, np.zeros(len(poses), np.int64), None)


def write_tum(path: Path, stamps: Sequence[float], poses: Sequence[Pose2]) -> None:
    """Write a line a pose: stamp (s), x, y, z (m, z 0) and a quaternion x, y, z, w."""
    rows = [
        f"{stamp:.6f} {pose.x:.9f} {pose.y:.9f} 0 0 0 "
        f"{math.sin(pose.theta / 2):.12f} {math.cos(pose.theta / 2):.12f}\n"
        for stamp, pose in zip(stamps, poses, strict=True)
    ]
    write_text(path, "".join(rows))


def write_kitti(path: Path, poses: Sequence[Pose2]) -> None:
    """Write a line a pose: the upper three rows of its (4, 4) matrix, z up; no stamps, no names."""
    rows = []
    for pose in poses:
        cosine, sine = math.cos(pose.theta), math.sin(pose.theta)
        rows.append(
            f"{cosine:.12f} {-sine:.12f} 0 {pose.x:.9f} "
            f"{sine:.12f} {cosine:.12f} 0 {pose.y:.9f} 0 0 1 0\n"
        )
    write_text(path, "".join(rows))
