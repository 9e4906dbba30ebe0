"""A run made by hand: two maps, a lost stretch with names that look like HTML, a false loop."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.core.camera.calibration import top_down_calibration
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.io.frames import list_frames
from slamcli.mapping.mapper import Mapper
from slamcli.run.paint.outputs import Overview, PaintedMaps
from slamcli.run.report.run import FinishedRun
from slamcli.selfcal import RegisteredDrive

HOSTILE = "</script><script>document.title='script'; "
SPREAD = np.diag([0.01, 0.01, 0.001]) ** 2


def estimate(index: int, pose: Pose2 | None, reason: str = "", fragment: int = 0) -> PoseEstimate:
    name = (
        f"{index:04d}.jpg" if pose else f"{index:04d} <img src=x onerror=document.title='img'>.jpg"
    )
    if pose is None:
        return PoseEstimate(index, name, None, None, "lost", reason)
    covariance = SPREAD * (1 + index)
    return PoseEstimate(
        index, name, 0.1 * index, pose, "tracked", "", fragment, covariance, 50, 0.99 - 0.01 * index
    )


def link(a: int, b: int, motion: Pose2, kind: str) -> Link:
    return Link(a, b, motion, SPREAD, 50, 0.99, kind)  # type: ignore[arg-type]


@pytest.fixture
def run(tmp_path: Path) -> FinishedRun:
    frames = tmp_path / "frames"
    frames.mkdir()
    rng = np.random.default_rng(0)
    for index in range(10):
        pixels = rng.integers(0, 255, (48, 64, 3), np.uint8)
        cv2.imwrite(str(frames / f"{index:04d}.jpg"), pixels)
    (frames / "0006.jpg").write_bytes(b"")
    poses = [Pose2(float(index), 0.5 * index, math.radians(10 * index)) for index in range(6)]
    estimates = [estimate(index, pose) for index, pose in enumerate(poses)]
    estimates[3] = estimate(3, None, "8 features; at least 15 are needed (to 0002.jpg)")
    estimates += [
        estimate(6, None, "the file is empty (0 bytes)"),
        estimate(7, None, "9 features; at least 15 are needed (to 0005.jpg)"),
        estimate(8, Pose2(), fragment=1),
        estimate(9, Pose2(1.0), fragment=1),
    ]
    off_by_a_centimetre = poses[0].inverse() @ poses[1] @ Pose2(0.01, 0.0, 0.0)
    links = [
        link(0, 1, off_by_a_centimetre, "step"),
        link(1, 2, poses[1].inverse() @ poses[2], "step"),
        link(0, 5, poses[0].inverse() @ poses[5], "loop"),
        link(1, 5, Pose2(3.0, 3.0), "loop"),
    ]
    camera = top_down_calibration((64, 48))
    image = np.full((60, 80, 3), (40, 90, 140), np.uint8)
    overview = Overview(image, Grid(-1.0, 4.0, 0.1, 80, 60))
    return FinishedRun(
        title=f"drive {HOSTILE}",
        note="no calibration: top-down frames, pixel units",
        rows=[("frames", "10"), ("placed", "7 (70%)"), ("links off", "1")],
        command="slam stitch 'a <b>&' --loops",
        files=list_frames([frames]),
        estimates=estimates,
        given=camera,
        registered=RegisteredDrive(camera, estimates, links, frozenset({3})),
        mapper=Mapper(camera),
        painted=PaintedMaps(1.0, (), (overview, None)),
    )
