"""The page of a live camera: its picture, the floor and the path so far, and the pose."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from importlib.resources import files

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.records import FloorMap, PoseEstimate
from slamcli.drawing.floor_picture import FloorPicture
from slamcli.io.containers.choice import Candidate, Counts, moving
from slamcli.io.live_camera import LiveCamera, Shot
from slamcli.io.loopback import Answer
from slamcli.run.live.trackers import Tracker

# The page's picture is at most about this wide.
_PICTURE_WIDTH = 800
# The map is drawn anew at most so often, for a limited share of the time.
_MAP_SECONDS, _MAX_MAP_SHARE = 1.0, 0.1
_LINE_SECONDS = 10.0
_MAX_PATH_POINTS = 2000
_JPEG_QUALITY = 80


class LivePage:
    """What the page shows, brought up to date frame by frame; threads of a server read it.

    Parameters
    ----------
    source : str
    camera : LiveCamera
    tracker : Tracker

    Attributes
    ----------
    tracker : Tracker
    line : str
        The state in one line.
    """

    def __init__(self, source: str, camera: LiveCamera, tracker: Tracker) -> None:
        self._source, self._camera, self.tracker = source, camera, tracker
        self._outline = footprint_hull(tracker.calibration)
        self._counts = Counts()
        self._floor = FloorPicture(tracker.view)
        self._placed = self._frames = 0
        self._path: list[tuple[float, float]] = []
        self._began = self._line_shown = time.monotonic()
        self._map_due = 0.0
        self._map, self._map_number = b"", 0
        self._state: dict[str, object] = {"source": source, "frames": 0, "status": "waiting"}
        self._page = _page()
        self.line = "no frame yet"

    def moving(self, stops: Callable[[], bool]) -> Iterator[Shot]:
        """Yield the camera's pictures, but those where it stands, until `stops` returns True."""
        candidates = (
            Candidate(shot.stamp, np.asarray(cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY)), shot)
            for shot in self._camera.shots(stops)
        )
        return (candidate.payload for candidate in moving(candidates, self._counts))

    def show(self, estimate: PoseEstimate) -> None:
        """Take one more frame's estimate."""
        self._frames += 1
        pose = estimate.map_from_robot
        self._placed += pose is not None
        if pose is not None:
            self._path.append((round(pose.x, 4), round(pose.y, 4)))
        if time.monotonic() >= self._map_due:
            self._draw(self.tracker.floor_map(), estimate)
        self._state = self._described(estimate)
        where = "" if pose is None else f", x {pose.x:.3f}, y {pose.y:.3f} {self._unit}"
        self.line = (
            f"{self._frames} frames, {self._placed} placed, {self._state['rate']}/s, "
            f"{self._camera.skipped} skipped, {self._counts.standing} standing; "
            f"{estimate.status}{where}{f', {estimate.reason}' if estimate.reason else ''}"
        )

    @property
    def counts(self) -> str:
        """What became of the camera's pictures, in one line."""
        return (
            f"{self._source}: {self._frames} frames used, {self._camera.skipped} skipped while "
            f"one was being placed, {self._counts.standing} left out where the camera stands"
        )

    @property
    def _unit(self) -> str:
        return self.tracker.calibration.unit

    def is_line_due(self) -> bool:
        """Return whether it is time to print the state, and note that it is printed."""
        now = time.monotonic()
        due = now - self._line_shown >= _LINE_SECONDS
        if due:
            self._line_shown = now
        return due

    def answer(self, path: str) -> Answer | None:
        """Return what the server is to send."""
        if path == "/":
            return Answer("text/html; charset=utf-8", self._page)
        if path == "/state.json":
            return Answer("application/json", json.dumps(self._state, allow_nan=False).encode())
        if path == "/picture.jpg":
            return Answer("image/jpeg", _jpeg(self._camera.newest.image))
        return Answer("image/png", self._map) if path == "/map.png" and self._map else None

    def _draw(self, floor_map: FloorMap | None, estimate: PoseEstimate) -> None:
        """Bring the picture of the floor up to date, and the path, as poses may have moved."""
        began = time.monotonic()
        if floor_map is not None:
            placed = {one.index: one for one in floor_map.estimates}
            fragment = max(estimate.fragment, 0)
            keyframes = [
                (keyframe, found.map_from_robot)
                for keyframe in floor_map.keyframes
                if (found := placed[keyframe.index]).map_from_robot is not None
                and found.fragment == fragment
            ]
            if self._floor.update([(one, pose) for one, pose in keyframes if pose is not None]):
                _, data = cv2.imencode(".png", _opaque(self._floor.image))
                self._map, self._map_number = data.tobytes(), self._map_number + 1
            if self.tracker.maps:
                self._path = [
                    (round(one.map_from_robot.x, 4), round(one.map_from_robot.y, 4))
                    for one in floor_map.estimates
                    if one.fragment == fragment and one.map_from_robot is not None
                ]
        now = time.monotonic()
        self._map_due = now + max(_MAP_SECONDS, (now - began) / _MAX_MAP_SHARE)

    def _described(self, estimate: PoseEstimate) -> dict[str, object]:
        """Return the state for the page's script."""
        pose, covariance, grid = estimate.map_from_robot, estimate.covariance, self._floor.grid
        step = -(-len(self._path) // _MAX_PATH_POINTS) or 1
        found: dict[str, object] = {
            "source": self._source,
            "mode": "mapping" if self.tracker.maps else "locating",
            "unit": self._unit,
            "frames": self._frames,
            "placed": self._placed,
            "skipped": self._camera.skipped,
            "standing": self._counts.standing,
            "rate": round(self._frames / max(time.monotonic() - self._began, 1e-3), 1),
            "status": estimate.status,
            "reason": estimate.reason,
            "fragment": estimate.fragment,
            "path": self._path[::step],
            "map": {
                "number": self._map_number,
                "x_min": grid.x_min,
                "y_max": grid.y_max,
                "scale": grid.metres_per_pixel,
                "width": grid.width,
                "height": grid.height,
            },
        }
        if pose is not None:
            found["pose"] = [pose.x, pose.y, pose.theta]
            found["ahead"] = pose.apply(self._outline).round(4).tolist()
        if pose is not None and covariance is not None:
            sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[1]))
            found["sigma"] = [sigma, math.degrees(math.sqrt(float(covariance[2, 2])))]
        if math.isfinite(estimate.score):
            found["score"] = estimate.score
        return found


def _page() -> bytes:
    folder = files("slamcli.run.live")
    text = folder.joinpath("page.html").read_text(encoding="utf-8")
    for mark, name in (("STYLE", "page.css"), ("SCRIPT", "page.js")):
        text = text.replace(f"/*{mark}*/", folder.joinpath(name).read_text(encoding="utf-8"))
    return text.encode()


def _opaque(image: UInt8Array) -> UInt8Array:
    """Return (h, w, 4) BGRA of (h, w, 2) gray and alpha."""
    return np.ascontiguousarray(image[..., [0, 0, 0, 1]])


def _jpeg(image: UInt8Array) -> bytes:
    """Return a picture for the page."""
    factor = max(1, round(image.shape[1] / _PICTURE_WIDTH))
    if factor > 1:
        size = image.shape[1] // factor, image.shape[0] // factor
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()
