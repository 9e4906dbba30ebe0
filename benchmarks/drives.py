"""Simulated drives for benchmarks, each made once and kept in a folder.

The folder is that of SLAMCLI_DRIVES, else one in the system's folder of temporary files. A drive's
name is a hash of its options, its poses and the simulator's source, so that none is out of date.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import slamcli
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.core.telemetry import OdometryReading
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import read_image
from slamcli.io.telemetry import read_odometry
from slamcli.io.trajectories import read_path
from slamcli.run.session.session import Session
from slamcli.run.simulate import simulate
from slamcli.simulation.config import SimulationOptions


@dataclass(frozen=True)
class Drive:
    """A finished drive.

    Attributes
    ----------
    folder : Path
        As `slam simulate` writes it.
    calibration : Calibration
        The true one.
    truth : list of Pose2
        The first frame's robot from each frame's robot.
    odometry : list of OdometryReading
    """

    folder: Path
    calibration: Calibration
    truth: list[Pose2]
    odometry: list[OdometryReading]

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return a frame's picture (H, W, 3) BGR."""
        return read_image(self.folder / "frames" / f"{index:04d}.jpg")

    def frame(self, index: int) -> Frame:
        """Return a frame, its stamp that of its odometry."""
        return Frame(index, f"{index:04d}", self.odometry[index].stamp, self.image(index))


def make_drive(options: SimulationOptions, poses: Sequence[Pose2] | None = None) -> Drive:
    """Return a drive, from the folder of drives where it is there already.

    Parameters
    ----------
    poses : sequence of Pose2, optional
        One for each frame, anywhere, in place of the options' path.
    """
    places = None if poses is None else [(pose.x, pose.y, pose.theta) for pose in poses]
    described = json.dumps([asdict(options), places, _source()], sort_keys=True)
    key = hashlib.sha256(described.encode()).hexdigest()[:20]
    root = os.environ.get("SLAMCLI_DRIVES") or Path(tempfile.gettempdir()) / "slamcli-drives"
    folder = Path(root) / key
    if not (folder / "truth.csv").exists():
        with tempfile.TemporaryDirectory() as scratch:
            if places is not None:
                way = Path(scratch) / "way.csv"
                lines = [f"{x!r},{y!r},{theta!r}" for x, y, theta in places]
                way.write_text("\n".join(["x,y,heading", *lines]))
                options = replace(options, path=str(way))
            simulate(folder, options, overwrite=True, session=Session(workers=1))
    calibration = load_calibration(folder / "camera.yaml")
    truth = read_path(folder / "truth.csv")
    return Drive(folder, calibration, truth, read_odometry(folder / "odometry.csv"))


@cache
def _source() -> str:
    """Return a hash of the simulator's source."""
    package = Path(slamcli.__file__).parent
    files = [*sorted((package / "simulation").rglob("*.py")), package / "run" / "simulate.py"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
