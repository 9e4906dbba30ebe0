"""What a bag has besides pictures: odometry, positions, headings, the lens, the antenna's place."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.telemetry import (
    COMPASS_SIGMA_RADIANS,
    GPS_SIGMA_METRES,
    CompassReading,
    GpsReading,
    OdometryReading,
)
from slamcli.io.containers.bag import Bag, Message, is_bag

ODOMETRY = "nav_msgs/msg/Odometry"
POSITIONS = "sensor_msgs/msg/NavSatFix"
HEADINGS = "sensor_msgs/msg/Imu"
LENSES = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
_STATIC = "/tf_static"
_ROBOT_FRAMES = frozenset({"base_link", "base_footprint"})
_MAX_TRANSFORMS = 100_000

Reading = TypeVar("Reading")


def split_topic(path: Path) -> tuple[Path, str]:
    """Return the path of a bag and the topic in ``drive.mcap:/odom``; no topic in other paths."""
    text, colon, topic = str(path).rpartition(":/")
    return (Path(text), f"/{topic}") if colon and is_bag(Path(text)) else (path, "")


def has_readings(path: Path) -> bool:
    """Return whether a path is a bag, or a topic of one."""
    return is_bag(split_topic(path)[0])


def reading_topics(path: Path) -> dict[str, str]:
    """Return the options that take a bag's readings, each with the topics that it would take."""
    bag = Bag(path)
    kinds = {"--odometry": ODOMETRY, "--gps": POSITIONS, "--compass": HEADINGS}
    topics = {option: ", ".join(bag.topics(kind)) for option, kind in kinds.items()}
    return {option: names for option, names in topics.items() if names}


def read_bag_odometry(path: Path) -> list[OdometryReading]:
    """Return the poses of the odometry topic, in the order of their stamps; raises InputError."""
    return _read(path, "Odometry", ODOMETRY, _odometry)


def read_bag_gps(path: Path) -> list[GpsReading]:
    """Return the positions with a fix, in the order of their stamps; raises InputError."""
    return _read(path, "NavSatFix", POSITIONS, _position)


def read_bag_compass(path: Path) -> list[CompassReading]:
    """Return the headings of the inertial unit's orientation, by stamp; raises InputError."""
    return _read(path, "Imu", HEADINGS, _heading)


def camera_info(path: Path, beside: str = "") -> dict[str, Any]:
    """Return the lens of a bag's camera, as a camera_info file has it.

    Parameters
    ----------
    beside : str
        The topic of the camera's pictures, which tells cameras apart.

    Raises
    ------
    InputError
    """
    path, named = split_topic(path)
    bag = Bag(path)
    topics = bag.topics(LENSES)
    own = {t: n for t, n in topics.items() if _parent(t) in (_parent(beside), _parent(beside, 2))}
    topic = bag.choose("CameraInfo", own or topics, named)
    first = next(bag.messages(topic), None)
    if first is None:
        raise InputError(f"{path} has no message on {topic}")
    # The keys of ROS 1 are upper case.
    fields = {name.lower(): value for name, value in vars(first.content).items()}
    return {
        "image_width": int(fields["width"]),
        "image_height": int(fields["height"]),
        "distortion_model": str(fields["distortion_model"]),
        "camera_matrix": {"rows": 3, "cols": 3, "data": np.asarray(fields["k"]).tolist()},
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(fields["d"]),
            "data": np.asarray(fields["d"]).tolist(),
        },
    }


def _parent(topic: str, levels: int = 1) -> str:
    return topic.rsplit("/", levels)[0]


def antenna_metres(path: Path) -> tuple[float, float] | None:
    """Return where the antenna is, metres ahead and left of the robot, by the static transforms.

    To the micrometre; None where the bag does not have them. Raises InputError.
    """
    path, named = split_topic(path)
    bag = Bag(path)
    fixes = bag.topics(POSITIONS)
    if not fixes or _STATIC not in bag.topics(*TRANSFORMS):
        return None
    first = next(bag.messages(bag.choose("NavSatFix", fixes, named)), None)
    if first is None:
        return None
    parents = _static_transforms(bag)
    frame, frame_from_antenna = _plain(first.content.header.frame_id), np.eye(4)
    # A circle of parents ends after as many steps as there are frames.
    for _ in range(len(parents) + 1):
        if frame in _ROBOT_FRAMES:
            ahead, left = frame_from_antenna[:2, 3].round(6).tolist()
            return ahead, left
        if frame not in parents:
            return None
        frame, step = parents[frame]
        frame_from_antenna = step @ frame_from_antenna
    return None


def _static_transforms(bag: Bag) -> dict[str, tuple[str, Float64Array]]:
    """Return each frame's parent and (4, 4) parent_from_frame."""
    found: dict[str, tuple[str, Float64Array]] = {}
    for message in bag.messages(_STATIC):
        for one in message.content.transforms[:_MAX_TRANSFORMS]:
            move, turn = one.transform.translation, one.transform.rotation
            matrix = np.eye(4)
            matrix[:3, :3] = _rotation(turn.w, turn.x, turn.y, turn.z)
            matrix[:3, 3] = move.x, move.y, move.z
            found[_plain(one.child_frame_id)] = _plain(one.header.frame_id), matrix
    return found


def _plain(frame: str) -> str:
    return frame.removeprefix("/")


def _rotation(w: float, x: float, y: float, z: float) -> Float64Array:
    """Return the (3, 3) rotation of a quaternion, of any length but 0."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not length > 0.0:
        return np.eye(3)
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _read(
    path: Path, what: str, kind: str, reading: Callable[[Message], Reading | None]
) -> list[Reading]:
    """Return the readings of a topic by their stamps."""
    path, named = split_topic(path)
    bag = Bag(path)
    topic = bag.choose(what, bag.topics(kind), named)
    found: list[tuple[int, Reading]] = []
    for message in bag.messages(topic):
        try:
            one = reading(message)
        except InputError as error:
            raise InputError(f"{path}, {topic}: {error}") from error
        if one is not None:
            found.append((message.stamp_ns, one))
    if not found:
        raise InputError(f"{path} has no {what} on {topic} that can be used")
    return [one for _, one in sorted(found, key=lambda pair: pair[0])]


def _seconds(message: Message) -> float:
    """Return a stamp as those of the frames are: to the microsecond."""
    return message.stamp_ns // 1000 / 1e6


def _yaw(turn: Any) -> float:
    """Return the heading of a quaternion, radians."""
    rotation = _rotation(turn.w, turn.x, turn.y, turn.z)
    return math.atan2(rotation[1, 0], rotation[0, 0])


def _odometry(message: Message) -> OdometryReading:
    pose = message.content.pose.pose
    place = Pose2(float(pose.position.x), float(pose.position.y), _yaw(pose.orientation))
    return OdometryReading(_seconds(message), place)


def _position(message: Message) -> GpsReading | None:
    fix = message.content
    if fix.status.status < 0:
        return None
    variance = 0.5 * float(fix.position_covariance[0] + fix.position_covariance[4])
    known = fix.position_covariance_type > 0 and variance > 0.0
    sigma = math.sqrt(variance) if known else GPS_SIGMA_METRES
    return GpsReading(_seconds(message), float(fix.latitude), float(fix.longitude), sigma)


def _heading(message: Message) -> CompassReading | None:
    """Return the heading; None where the unit has no orientation (REP 145)."""
    covariance = message.content.orientation_covariance
    turn = message.content.orientation
    if covariance[0] < 0.0 or (turn.w, turn.x, turn.y, turn.z) == (0.0, 0.0, 0.0, 0.0):
        return None
    variance = float(covariance[8])
    sigma = math.sqrt(variance) if variance > 0.0 else COMPASS_SIGMA_RADIANS
    return CompassReading(_seconds(message), _yaw(turn), sigma)
