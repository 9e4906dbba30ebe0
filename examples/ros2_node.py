"""Localise a camera on a robot with ROS 2: images in, poses out, while it drives.

    python examples/ros2_node.py calibration.yaml --topic /camera/image_raw
    python examples/ros2_node.py --map out/map.slam --topic /camera/image_raw

Runs in a process of its own, in a shell where ROS 2 was set up and slamcli is installed. It
publishes geometry_msgs/PoseWithCovarianceStamped on /slam/pose, in the frame "map". A robot with
odometry of its own gives that to robot_localization; --tf publishes it as the transform from map to
base_link, for a robot without.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import slamcli

# Channels of an encoding, and how it becomes BGR; mono8 stays as it is.
ENCODINGS = {
    "bgr8": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, None),
}


def pixels_of(message: Any) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image; raises KeyError for other encodings."""
    channels, conversion = ENCODINGS[message.encoding]
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    used = rows[:, : message.width * channels]
    if channels == 1:
        return np.ascontiguousarray(used)
    picture = used.reshape(message.height, message.width, channels)
    return (
        np.ascontiguousarray(picture) if conversion is None else cv2.cvtColor(picture, conversion)
    )


def turn(quaternion: Any, heading: float) -> None:
    """Fill a geometry_msgs/Quaternion with a turn about the vertical, radians."""
    quaternion.z, quaternion.w = math.sin(heading / 2), math.cos(heading / 2)


def covariance_of(pose: slamcli.Pose2, covariance: np.ndarray) -> list[float]:
    """Return the 36 numbers of a PoseWithCovariance: in the map's axes, of x, y and yaw."""
    map_from_own = np.eye(3)
    map_from_own[:2, :2] = pose.matrix[:2, :2]
    planar = map_from_own @ covariance @ map_from_own.T
    whole = np.zeros((6, 6))
    whole[np.ix_([0, 1, 5], [0, 1, 5])] = planar
    return [float(value) for value in whole.ravel()]


class SlamNode:
    """Subscribes to images, and publishes where the robot is.

    Parameters
    ----------
    node : rclpy.node.Node
    locate : function
        Of a frame: its estimate.
    """

    def __init__(
        self,
        node: Any,
        locate: Callable[[slamcli.Frame], slamcli.PoseEstimate],
        topic: str,
        *,
        tf: bool,
    ) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import Image
        from tf2_ros import TransformBroadcaster

        self.node, self.locate, self.count = node, locate, 0
        self.pose_type, self.transform_type = PoseWithCovarianceStamped, TransformStamped
        self.publisher = node.create_publisher(PoseWithCovarianceStamped, "/slam/pose", 10)
        self.broadcaster = TransformBroadcaster(node) if tf else None
        # Of a camera only the newest pictures are of use: best effort, and few are kept.
        node.create_subscription(Image, topic, self.on_image, qos_profile_sensor_data)

    def on_image(self, message: Any) -> None:
        """Locate one image."""
        log = self.node.get_logger()
        try:
            picture = pixels_of(message)
        except (KeyError, ValueError):
            log.error(f"an image of {message.encoding!r} that cannot be read")
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        frame = slamcli.Frame(self.count, f"{stamp:.6f}", stamp, picture)
        self.count += 1
        # It never raises on a bad frame: it returns why the frame has no pose.
        estimate = self.locate(frame)
        pose, covariance = estimate.map_from_robot, estimate.covariance
        if pose is None or covariance is None:
            log.warning(f"{estimate.name}: {estimate.reason}")
            return
        self.publish(message.header.stamp, pose, covariance)

    def publish(self, stamp: Any, pose: slamcli.Pose2, covariance: np.ndarray) -> None:
        """Publish a pose with its covariance, in the robot's own axes as estimates have it."""
        message = self.pose_type()
        message.header.stamp, message.header.frame_id = stamp, "map"
        message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
        turn(message.pose.pose.orientation, pose.theta)
        message.pose.covariance = covariance_of(pose, covariance)
        self.publisher.publish(message)
        if self.broadcaster is not None:
            transform = self.transform_type()
            transform.header.stamp, transform.header.frame_id = stamp, "map"
            transform.child_frame_id = "base_link"
            transform.transform.translation.x = pose.x
            transform.transform.translation.y = pose.y
            turn(transform.transform.rotation, pose.theta)
            self.broadcaster.sendTransform(transform)


def main() -> None:
    """Run the node until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("calibration", type=Path, nargs="?", help="by `slam calibrate`")
    parser.add_argument("--map", type=Path, help="locate in this map.slam, whose camera is used")
    parser.add_argument("--topic", default="/camera/image_raw", help="of sensor_msgs/Image")
    parser.add_argument("--tf", action="store_true", help="also publish map -> base_link")
    arguments = parser.parse_args()
    if (arguments.calibration is None) == (arguments.map is None):
        parser.error("give a calibration, or --map")

    import rclpy

    if arguments.map is not None:
        locate = slamcli.Follower(slamcli.Locator(slamcli.load_map(arguments.map))).update
    else:
        locate = slamcli.Mapper(slamcli.load_calibration(arguments.calibration)).update
    rclpy.init()
    node = rclpy.create_node("slam")
    SlamNode(node, locate, arguments.topic, tf=arguments.tf)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
