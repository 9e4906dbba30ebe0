"""The examples: each runs on the samples that the repository ships, a few frames of them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FRAMES = ROOT / "samples" / "course" / "frames"
EXAMPLES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))


def run(example: str, *arguments: object, paths: Sequence[Path] = ()) -> str:
    """Return what an example prints; modules in `paths` come first."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / f"{example}.py"), *map(str, arguments)],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, [*paths, ROOT])),
            "OPENBLAS_NUM_THREADS": "1",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of the sample drive, by the command that the README shows."""
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    command = [sys.executable, "-m", "slamcli", "calibrate", "samples/course/square.png"]
    subprocess.run([*command, "-o", str(path)], cwd=ROOT, check=True, capture_output=True)
    return path


def test_every_example_is_tested() -> None:
    tests = Path(__file__).read_text(encoding="utf-8")
    assert EXAMPLES
    for example in EXAMPLES:
        assert f'run("{example}"' in tests


def test_stream_from_camera(calibration: Path) -> None:
    lines = run("stream_from_camera", FRAMES, calibration, "--frames", 4).splitlines()
    assert len(lines) == 5
    assert lines[1].startswith("frame 1: tracked x 0.079")
    assert lines[-1].startswith("4 of 4 frames placed")


def test_map_a_folder_and_localise_in_it(calibration: Path, tmp_path: Path) -> None:
    frames = [FRAMES / f"{number:04}.jpg" for number in range(4)]
    (tmp_path / "frames").mkdir()
    for path in frames[:3]:
        (tmp_path / "frames" / path.name).write_bytes(path.read_bytes())
    lines = run("map_a_folder", tmp_path / "frames", calibration, tmp_path / "out").splitlines()
    assert [line.split(":")[0] for line in lines if ": x " in line] == [p.name for p in frames[:3]]
    assert (tmp_path / "out" / "mosaic.png").exists()
    found = run("localise_in_a_map", tmp_path / "out" / "map.slam", *frames[1:3]).splitlines()
    assert found[0].startswith("0001.jpg: x 0.079")
    assert found[1].startswith("0002.jpg: x 0.157")


ROS = """
import sys, types
from types import SimpleNamespace

def fields(**values):
    return lambda: SimpleNamespace(**{k: v() if callable(v) else v for k, v in values.items()})

header = fields(stamp=None, frame_id="")
point, turn = fields(x=0.0, y=0.0, z=0.0), fields(x=0.0, y=0.0, z=0.0, w=1.0)
pose = fields(pose=fields(position=point, orientation=turn), covariance=None)
messages = {
    "geometry_msgs": {},
    "geometry_msgs.msg": {
        "PoseWithCovarianceStamped": fields(header=header, pose=pose),
        "TransformStamped": fields(
            header=header, child_frame_id="", transform=fields(translation=point, rotation=turn)
        ),
    },
    "sensor_msgs": {},
    "sensor_msgs.msg": {"Image": object},
    "rclpy.qos": {"qos_profile_sensor_data": 5},
}

class Node:
    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: print(
            topic, message.header.frame_id, message.header.stamp.sec,
            round(message.pose.pose.position.x, 2), round(message.pose.pose.orientation.w, 2),
            len(message.pose.covariance), message.pose.covariance[35] > 0.0,
        ))
    def create_subscription(self, kind, topic, function, qos):
        self.take = function
    def get_logger(self):
        return SimpleNamespace(error=print, warning=print)
    def destroy_node(self):
        print("destroyed")

node = Node()

def spin(_):
    import cv2, numpy as np
    for number, encoding in ((0, "bgr8"), (1, "bgr8"), (2, "rgb8"), (3, "mono8"), (4, "32FC1")):
        picture = cv2.imread(f"samples/course/frames/{number:04}.jpg")
        if encoding == "rgb8":
            picture = picture[..., ::-1]
        if encoding == "mono8":
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)[..., None]
        height, width, channels = picture.shape
        rows = np.hstack([picture.reshape(height, -1), np.zeros((height, 6), np.uint8)])
        node.take(SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=100 + number, nanosec=5)),
            encoding=encoding, width=width, height=height,
            step=rows.shape[1], data=rows.tobytes(),
        ))
    raise KeyboardInterrupt

class Broadcaster:
    def __init__(self, node):
        pass
    def sendTransform(self, one):
        print(one.header.frame_id, one.child_frame_id, round(one.transform.translation.x, 2))

messages["tf2_ros"] = {"TransformBroadcaster": Broadcaster}
messages["rclpy"] = {
    "init": lambda: None, "create_node": lambda name: node, "spin": spin,
    "try_shutdown": lambda: print("shut down"),
}
for name, content in messages.items():
    module = sys.modules[name] = types.ModuleType(name)
    vars(module).update(content)
"""


def test_the_ros_2_node(calibration: Path, tmp_path: Path) -> None:
    """With stand-ins for the modules of ROS: images of three encodings go through it."""
    (tmp_path / "sitecustomize.py").write_text(ROS)
    lines = run("ros2_node", calibration, "--tf", paths=[tmp_path]).splitlines()
    assert lines[0] == "/slam/pose map 100 0.0 1.0 36 True"
    assert lines[2].startswith("/slam/pose map 101 0.08 ")
    assert lines[3] == "map base_link 0.08"
    assert lines[4].startswith("/slam/pose map 102 0.16 ")
    assert lines[6].startswith("/slam/pose map 103 0.2")
    assert lines[8:] == ["an image of '32FC1' that cannot be read", "destroyed", "shut down"]


def test_evaluate_against_truth(calibration: Path) -> None:
    folder = ROOT / "samples" / "course"
    printed = run("evaluate_against_truth", folder, calibration, "--frames", 5, "--limit-mm", 1)
    assert "ATE 0." in printed
