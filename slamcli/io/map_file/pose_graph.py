"""The pose graph in a map file: every frame's estimate, and all links."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np

from slamcli.core.arrays import AnyArray, Float64Array
from slamcli.core.bounds import COORDINATE
from slamcli.core.camera.calibration import Rocking
from slamcli.core.errors import MapError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, LinkKind, PoseEstimate, Status

DRIVE_KINDS = {
    "frames": "<i8",
    "frame_numbers": "<f8",
    "frame_covariances": "<f8",
    "links": "<i8",
    "link_numbers": "<f8",
    "link_covariances": "<f8",
    "texts": "|u1",
}
# Of each frame: index, fragment, status, inliers, and how many bytes of name and reason it has; and
# stamp, pose, score and rocking, nan where there is none.
_FRAME_COLUMNS, _FRAME_NUMBERS = 6, 8
# Of each link: a, b, kind and inliers; and motion and score.
_LINK_COLUMNS, _LINK_NUMBERS = 4, 4
_STATUSES: tuple[Status, ...] = get_args(Status)
_LINK_KINDS: tuple[LinkKind, ...] = get_args(LinkKind)
_NO_COVARIANCE = np.full((3, 3), np.nan)


def drive_arrays(estimates: Sequence[PoseEstimate], links: Sequence[Link]) -> dict[str, AnyArray]:
    """Return what `parse_drive` reads back; `revised` and `odom_from_robot` are left out."""
    texts = [(_encoded(e.name), _encoded(e.reason)) for e in estimates]
    frames = [
        (e.index, e.fragment, _STATUSES.index(e.status), e.inliers, len(name), len(reason))
        for e, (name, reason) in zip(estimates, texts, strict=True)
    ]
    covariances = [_NO_COVARIANCE if e.covariance is None else e.covariance for e in estimates]
    kinds = [(k.a, k.b, _LINK_KINDS.index(k.kind), k.inliers) for k in links]
    motions = [(k.a_from_b.x, k.a_from_b.y, k.a_from_b.theta, k.score) for k in links]
    return {
        "frames": np.array(frames, "<i8").reshape(-1, _FRAME_COLUMNS),
        "frame_numbers": np.array([_numbers(e) for e in estimates], "<f8"),
        "frame_covariances": np.array(covariances, "<f8").reshape(-1, 3, 3),
        "links": np.array(kinds, "<i8").reshape(-1, _LINK_COLUMNS),
        "link_numbers": np.array(motions, "<f8").reshape(-1, _LINK_NUMBERS),
        "link_covariances": np.array([k.covariance for k in links], "<f8").reshape(-1, 3, 3),
        "texts": np.frombuffer(b"".join(name + reason for name, reason in texts), "|u1"),
    }


def _encoded(text: str) -> bytes:
    """Return a text, or a name that is not UTF-8, as the bytes that it was made of."""
    return text.encode("utf-8", "surrogateescape")


def _numbers(estimate: PoseEstimate) -> list[float]:
    pose, rocking = estimate.map_from_robot, estimate.rocking
    nothing = [math.nan] * 3
    return [
        math.nan if estimate.stamp is None else estimate.stamp,
        *(nothing if pose is None else (pose.x, pose.y, pose.theta)),
        estimate.score,
        *(
            nothing
            if rocking is None
            else (rocking.pitch_radians, rocking.roll_radians, rocking.height_metres)
        ),
    ]


def parse_drive(
    arrays: Mapping[str, AnyArray],
) -> tuple[tuple[PoseEstimate, ...], tuple[Link, ...]]:
    """Return estimates and links, each number checked; raises MapError."""
    _check_frames(arrays)
    _check_links(arrays)
    ends = np.cumsum(arrays["frames"][:, 4:6].sum(axis=1))
    texts = arrays["texts"].tobytes()
    estimates = []
    for row, (index, fragment, status, inliers, name, reason) in enumerate(
        arrays["frames"].tolist()
    ):
        stamp, x, y, theta, score, *rocking = arrays["frame_numbers"][row].tolist()
        text = texts[int(ends[row]) - name - reason : int(ends[row])]
        placed = math.isfinite(x)
        estimates.append(
            PoseEstimate(
                index,
                text[:name].decode("utf-8", "surrogateescape"),
                None if math.isnan(stamp) else stamp,
                Pose2(x, y, theta) if placed else None,
                _STATUSES[status],
                text[name:].decode("utf-8", "surrogateescape"),
                fragment,
                arrays["frame_covariances"][row] if placed else None,
                inliers,
                score,
                rocking=None if math.isnan(rocking[0]) else Rocking(*rocking),
            )
        )
    links = [
        Link(a, b, Pose2(x, y, theta), covariance, inliers, score, _LINK_KINDS[kind])
        for (a, b, kind, inliers), (x, y, theta, score), covariance in zip(
            arrays["links"].tolist(),
            arrays["link_numbers"].tolist(),
            arrays["link_covariances"],
            strict=True,
        )
    ]
    return tuple(estimates), tuple(links)


def expect(arrays: Mapping[str, AnyArray], name: str, shape: tuple[int, ...]) -> None:
    """Raise MapError when an array has another shape."""
    if arrays[name].shape != shape:
        raise MapError(f"its {name} have shape {arrays[name].shape}; {shape} is needed")


def _check_frames(arrays: Mapping[str, AnyArray]) -> None:
    frames, numbers = arrays["frames"], arrays["frame_numbers"]
    count = len(frames)
    expect(arrays, "frames", (count, _FRAME_COLUMNS))
    expect(arrays, "frame_numbers", (count, _FRAME_NUMBERS))
    expect(arrays, "frame_covariances", (count, 3, 3))
    whole = np.delete(frames, 1, axis=1)
    if not count or whole.min() < 0 or frames[:, 1].min() < -1 or frames.max() >= 2**31:
        raise MapError("the numbers of its frames are wrong")
    if np.any(np.diff(frames[:, 0]) <= 0) or frames[:, 2].max() >= len(_STATUSES):
        raise MapError("the numbers of its frames are wrong")
    if frames[:, 4:6].sum() != len(arrays["texts"]):
        raise MapError("the lengths of its names are wrong")
    if np.isinf(numbers).any():
        raise MapError("its frames have a number that is not finite")
    placed = np.isfinite(numbers[:, 1:4])
    has_pose = frames[:, 2] != _STATUSES.index("lost")
    if not np.array_equal(placed.all(axis=1), has_pose) or placed[~has_pose].any():
        raise MapError("a placed frame has no pose, or a lost one has one")
    _check_poses(numbers[has_pose, 1:3], arrays["frame_covariances"][has_pose])
    tilted = np.isfinite(numbers[:, 5:])
    if np.any(tilted.any(axis=1) != tilted.all(axis=1)):
        raise MapError("a frame's rocking is incomplete")


def _check_links(arrays: Mapping[str, AnyArray]) -> None:
    links, numbers = arrays["links"], arrays["link_numbers"]
    expect(arrays, "links", (len(links), _LINK_COLUMNS))
    expect(arrays, "link_numbers", (len(links), _LINK_NUMBERS))
    expect(arrays, "link_covariances", (len(links), 3, 3))
    if not len(links):
        return
    known = np.isin(links[:, :2], arrays["frames"][:, 0]).all() and np.all(
        links[:, 0] != links[:, 1]
    )
    if not known or links.min() < 0 or links[:, 2].max() >= len(_LINK_KINDS):
        raise MapError("the numbers of its links are wrong")
    if not np.isfinite(numbers[:, :3]).all() or np.isinf(numbers).any():
        raise MapError("its links have a number that is not finite")
    _check_poses(
        numbers[:, :2], arrays["link_covariances"], min_eigenvalue=np.finfo(np.float64).tiny
    )


def _check_poses(
    positions: Float64Array, covariances: Float64Array, min_eigenvalue: float = -1e-12
) -> None:
    """Refuse a pose farther away than any floor, and a matrix that is no covariance."""
    if np.abs(positions).max(initial=0.0) > COORDINATE.high:
        raise MapError(f"a pose is more than {COORDINATE.high:g} from the origin")
    if not np.isfinite(covariances).all():
        raise MapError("its covariances have a number that is not finite")
    symmetric = np.allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-6, atol=1e-12)
    if not symmetric or np.linalg.eigvalsh(covariances).min(initial=1.0) < min_eigenvalue:
        raise MapError("a covariance is not symmetric or not positive")
