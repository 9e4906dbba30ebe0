"""A painted map on its way to files: where its tiles are, and how it is written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Unit
from slamcli.core.config import ProductOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.io.raster.tile_store import TileStore
from slamcli.run.session.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class MapToWrite:
    """A painted map, and where and how it is written.

    Attributes
    ----------
    folder : Path
    suffix : str
        After each file's stem: empty for the first map, ``_1`` for the next.
    store : TileStore
    grid : Grid
        The part of it that is written.
    map_from_painted : Pose2
    options : ProductOptions
    session : Session
        Of this machine, which has the tiles.
    calibration : Calibration
    positions : (N, 2) float64
        Of the robot at every placed frame, in the axes that the map is painted in.
    """

    folder: Path
    suffix: str
    store: TileStore
    grid: Grid
    map_from_painted: Pose2
    options: ProductOptions
    session: Session
    calibration: Calibration
    positions: Float64Array

    @property
    def unit(self) -> Unit:
        """Of lengths."""
        return self.calibration.unit

    def path(self, stem: str, ending: str) -> Path:
        """Return where one output of this map is written."""
        return self.folder / f"{stem}{self.suffix}{ending}"
