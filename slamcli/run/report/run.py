"""A finished run, as far as its page shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slamcli.core.camera.calibration import Calibration
from slamcli.core.records import PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.io.frames import FrameFile
from slamcli.mapping.mapper import Mapper
from slamcli.run.paint.outputs import PaintedMaps
from slamcli.selfcal import RegisteredDrive, SelfCalibration


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """What the page is made from.

    Attributes
    ----------
    title, note : str
        What was mapped, and the line on its calibration.
    rows : sequence of (str, str)
        The closing table, without times and lost frames.
    command : str
        The command line that repeats the run; empty when it is not known.
    files : sequence of FrameFile
        Of the frames that the run came to.
    estimates : sequence of PoseEstimate
        One for every frame, also for those that it did not come to.
    given : Calibration
        The camera before self-calibration.
    registered : RegisteredDrive
        The final camera, poses and links.
    mapper : Mapper
        Which has the sensors' readings.
    painted : PaintedMaps
    self_calibration : SelfCalibration or None
    survey : sequence of (str, str) or None
        What a survey found of its camera.
    georeferences : mapping of int to Georeference
        Where on Earth each map lies.
    """

    title: str
    note: str
    rows: Sequence[tuple[str, str]]
    command: str
    files: Sequence[FrameFile]
    estimates: Sequence[PoseEstimate]
    given: Calibration
    registered: RegisteredDrive
    mapper: Mapper
    painted: PaintedMaps
    self_calibration: SelfCalibration | None = None
    survey: Sequence[tuple[str, str]] | None = None
    georeferences: Mapping[int, Georeference] = field(default_factory=dict)

    @property
    def calibration(self) -> Calibration:
        """The camera that the poses are for."""
        return self.registered.calibration
