"""Localisation of single frames in a finished map."""

from __future__ import annotations

from dataclasses import replace

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import MapperOptions
from slamcli.core.failures import FAILURES, logged
from slamcli.core.records import FloorMap, Frame, PoseEstimate, PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraph, lost
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.mapping.locks import ReentrantLock
from slamcli.mapping.preprocessing import Preprocessor
from slamcli.mapping.relocalization import Relocalizer


class Locator:
    """Finds frames in a map, each by itself: nothing is known of where the robot was before.

    `locate` never raises, whatever the frame, and threads may share a locator.

    Parameters
    ----------
    floor_map : FloorMap
        From `slamcli.load_map`.
    """

    def __init__(self, floor_map: FloorMap) -> None:
        self.calibration = floor_map.calibration
        options = replace(
            MapperOptions(),
            features=floor_map.features,
            metres_per_pixel=floor_map.metres_per_pixel,
            tilt_sigma_degrees=floor_map.tilt_sigma_degrees,
        )
        self._preprocessor = Preprocessor(floor_map.calibration, options)
        database = KeyframeDatabase(self._preprocessor.grid, options.matching.seed)
        self._relocalizer = Relocalizer(floor_map.calibration, options, database)
        self._graph = PoseGraph()
        for keyframe in floor_map.keyframes:
            database.add(keyframe)
        for estimate in floor_map.estimates:
            self._graph.set_estimate(estimate)
        self._count, self._lock = 0, ReentrantLock()

    def locate(self, frame: Frame | UInt8Array) -> PoseEstimate:
        """Return where a frame is on the map; lost, with the reason, when it is not there.

        Parameters
        ----------
        frame : Frame, or (H, W[, 3]) uint8 BGR or gray pixels

        Returns
        -------
        PoseEstimate
            Its covariance is that of the map's keyframe and of the link to it; its score
            how likely that link is right.
        """
        if not isinstance(frame, Frame):
            with self._lock:
                frame = Frame(self._count, f"frame {self._count}", None, frame)
                self._count += 1
        return self.place(self.prepare(frame))

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Compute all that needs no map; may run ahead on any thread. Never raises."""
        return self._preprocessor.prepare(frame)

    def place(self, prepared: PreparedFrame) -> PoseEstimate:
        """Return where a prepared frame is on the map, as `locate`."""
        if prepared.features is None:
            return lost(prepared, prepared.reason)
        try:
            candidates = self._relocalizer.query(prepared.features)
            found = self._relocalizer.verify(prepared, candidates, self._graph)
            if found.link is None:
                return lost(prepared, found.reason)
            return self._graph.predict_pose(prepared, [found.link])
        except FAILURES as error:
            return lost(prepared, f"cannot be located: {logged(error)}")
