"""Short ROS bags for tests, written by rosbags."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000


class BagWriter:
    """A bag of ROS 1, named ``.bag``, or of ROS 2: a folder, with ``.mcap`` if it is named so."""

    def __init__(self, path: Path) -> None:
        self.one = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.one else Stores.ROS2_HUMBLE)
        if self.one:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.writer: Any = Writer1(path)
        else:
            kind = StoragePlugin.MCAP if path.name.endswith("_mcap") else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=kind)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def add(self, topic: str, kind: str, seconds: float, message: Any) -> None:
        """Write a message as recorded 20 ms after its stamp."""
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        encode = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        record_ns = round((seconds + 0.02) * 1e9) + START * 10**9
        self.writer.write(self.connections[topic], record_ns, encode(message, kind))

    def header(self, seconds: float, frame: str = "camera") -> Any:
        nanoseconds = round(seconds * 1e9)
        whole, rest = START + nanoseconds // 10**9, nanoseconds % 10**9
        time = self.store.types["builtin_interfaces/msg/Time"](sec=whole, nanosec=rest)
        more = {"seq": 0} if self.one else {}
        return self.store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

    def image(self, topic: str, seconds: float, pixels: np.ndarray, encoding: str) -> None:
        kind = "sensor_msgs/msg/Image"
        pad = np.zeros((pixels.shape[0], 8), np.uint8)
        rows = np.hstack([pixels.reshape(len(pixels), -1).view(np.uint8), pad])
        message = self.store.types[kind](
            header=self.header(seconds),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.ravel(),
        )
        self.add(topic, kind, seconds, message)

    def compressed(self, topic: str, seconds: float, data: bytes) -> None:
        kind = "sensor_msgs/msg/CompressedImage"
        content = np.frombuffer(data, np.uint8)
        message = self.store.types[kind](header=self.header(seconds), format="png", data=content)
        self.add(topic, kind, seconds, message)

    def odometry(self, topic: str, seconds: float, x: float, y: float, heading: float) -> None:
        kind, types = "nav_msgs/msg/Odometry", self.store.types
        zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        message = types[kind](
            header=self.header(seconds, "odom"),
            child_frame_id="base_link",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](
                pose=types["geometry_msgs/msg/Pose"](
                    position=types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
                    orientation=self.turn(heading),
                ),
                covariance=np.zeros(36),
            ),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](
                twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )
        self.add(topic, kind, seconds, message)

    def turn(self, heading: float) -> Any:
        quaternion = self.store.types["geometry_msgs/msg/Quaternion"]
        return quaternion(x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2))

    def fix(self, seconds: float, latitude: float, longitude: float, status: int = 0) -> None:
        kind, types = "sensor_msgs/msg/NavSatFix", self.store.types
        message = types[kind](
            header=self.header(seconds, "gps"),
            status=types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
            latitude=latitude,
            longitude=longitude,
            altitude=0.0,
            position_covariance=np.diag([0.25, 0.25, 1.0]).ravel(),
            position_covariance_type=2,
        )
        self.add("/fix", kind, seconds, message)

    def imu(self, seconds: float, heading: float) -> None:
        kind, types = "sensor_msgs/msg/Imu", self.store.types
        zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        message = types[kind](
            header=self.header(seconds, "imu"),
            orientation=self.turn(heading),
            orientation_covariance=np.diag([0.1, 0.1, 0.01]).ravel(),
            angular_velocity=zero,
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=zero,
            linear_acceleration_covariance=np.zeros(9),
        )
        self.add("/imu", kind, seconds, message)

    def lens(self, topic: str, size: tuple[int, int], focal: float) -> None:
        kind, types = "sensor_msgs/msg/CameraInfo", self.store.types
        matrix = np.array([focal, 0, size[0] / 2, 0, focal, size[1] / 2, 0, 0, 1.0])
        values = {"d": np.zeros(5), "k": matrix, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        if self.one:
            values = {name.upper(): value for name, value in values.items()}
        roi = types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        message = types[kind](
            header=self.header(0.0),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **values,
        )
        self.add(topic, kind, 0.0, message)

    def transform(self, parent: str, child: str, x: float, y: float, heading: float) -> None:
        kind, types = "tf2_msgs/msg/TFMessage", self.store.types
        one = types["geometry_msgs/msg/TransformStamped"](
            header=self.header(0.0, parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](x=x, y=y, z=0.0),
                rotation=self.turn(heading),
            ),
        )
        self.add("/tf_static", kind, 0.0, types[kind](transforms=[one]))


def write_bag(
    path: Path,
    pictures: Sequence[np.ndarray],
    more: Callable[[BagWriter], None] | None = None,
    *,
    encoding: str = "bgr8",
    step_seconds: float = 0.1,
) -> Path:
    """Write a bag of BGR pictures; `png` compresses them. Return what is to be read."""
    with BagWriter(path) as bag:
        for number, picture in enumerate(pictures):
            seconds = number * step_seconds
            if encoding == "png":
                data = cv2.imencode(".png", picture)[1].tobytes()
                bag.compressed("/camera/image/compressed", seconds, data)
            else:
                bag.image("/camera/image", seconds, picture, encoding)
        if more is not None:
            more(bag)
    return path
