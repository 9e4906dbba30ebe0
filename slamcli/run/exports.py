"""What `slam stitch --export` writes beside the map, for other tools."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamcli.core.errors import InputError
from slamcli.graph import placed_fragments
from slamcli.io.graphs import write_g2o
from slamcli.io.trajectories import write_kitti, write_tum

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Link, PoseEstimate
    from slamcli.io.frames import FrameFile

PRODUCTS = ("trajectory*.tum", "trajectory*.kitti", "graph*.g2o")


def check_exports(kinds: Sequence[str], files: Sequence[FrameFile]) -> None:
    """Refuse, before the work, what could not be written after it; raises InputError."""
    unstamped = next((file for file in files if file.stamp is None), None)
    if "tum" in kinds and unstamped is not None:
        raise InputError(
            f"{unstamped.path} has no stamp, which --export tum needs; give --frame-rate"
        )


def write_exports(
    folder: Path, kinds: Sequence[str], estimates: Sequence[PoseEstimate], links: Sequence[Link]
) -> None:
    """Write what was asked for, a file a fragment."""
    for fragment, members in placed_fragments(estimates).items():
        suffix = "" if fragment == 0 else f"_{fragment}"
        for kind in kinds:
            EXPORTS[kind](folder, suffix, members, links)


def _tum(
    folder: Path, suffix: str, members: Sequence[PoseEstimate], _links: Sequence[Link]
) -> None:
    stamps = [member.stamp for member in members if member.stamp is not None]
    write_tum(folder / f"trajectory{suffix}.tum", stamps, list(_poses(members).values()))


def _kitti(
    folder: Path, suffix: str, members: Sequence[PoseEstimate], _links: Sequence[Link]
) -> None:
    write_kitti(folder / f"trajectory{suffix}.kitti", list(_poses(members).values()))


def _g2o(folder: Path, suffix: str, members: Sequence[PoseEstimate], links: Sequence[Link]) -> None:
    write_g2o(folder / f"graph{suffix}.g2o", _poses(members), links)


def _poses(members: Sequence[PoseEstimate]) -> dict[int, Pose2]:
    return {m.index: m.map_from_robot for m in members if m.map_from_robot is not None}


EXPORTS: dict[str, Callable[[Path, str, Sequence[PoseEstimate], Sequence[Link]], None]] = {
    "tum": _tum,
    "kitti": _kitti,
    "g2o": _g2o,
}
