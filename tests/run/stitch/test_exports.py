"""What other tools read: trajectories by evo, the pose graph by GTSAM."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import slam

from slamcli.core.geometry import Pose2, pose_array, relative_poses
from slamcli.core.records import Link
from slamcli.io.g2o import write_g2o, write_links
from slamcli.io.trajectories import read_trajectory, write_kitti, write_tum

POSES = [Pose2(0.3 * i, 0.02 * i * i, 0.9 * i) for i in range(9)]


def test_evo_reads_the_trajectories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # evo writes its settings into the home folder when it is first imported.
    monkeypatch.setenv("HOME", str(tmp_path))
    stamps = [1446412345.25 + 0.1 * i for i in range(9)]
    write_tum(tmp_path / "a.tum", stamps, POSES)
    write_kitti(tmp_path / "a.kitti", POSES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("evo")
        from evo.tools import file_interface

        tum = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
        kitti = file_interface.read_kitti_poses_file(str(tmp_path / "a.kitti"))
        assert all(path.check()[0] for path in (tum, kitti))
    np.testing.assert_allclose(tum.timestamps, stamps, atol=1e-6)
    for path in (tum, kitti):
        for matrix, pose in zip(path.poses_se3, POSES, strict=True):
            np.testing.assert_allclose(matrix[:2, :2], pose.matrix[:2, :2], atol=1e-9)
            np.testing.assert_allclose(matrix[:3, 3], [pose.x, pose.y, 0.0], atol=1e-8)
    for name in ("a.tum", "a.kitti"):
        read = read_trajectory(tmp_path / name)
        np.testing.assert_allclose(relative_poses(read.poses, pose_array(POSES)), 0.0, atol=1e-8)


def test_gtsam_reads_the_graph(tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    generator = np.random.default_rng(0)
    links = []
    for a, b in [(0, 1), (1, 2), (2, 5), (5, 0), (5, 7)]:
        root = 0.01 * generator.normal(size=(3, 3))
        covariance = root @ root.T + 1e-6 * np.eye(3)
        links.append(Link(a, b, Pose2(*generator.normal(size=3)), covariance, 9, 0.9, "step"))
    poses = {index: POSES[index] for index in (0, 1, 2, 5)}
    write_g2o(tmp_path / "graph.g2o", poses, links)
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), False)
    # The last link leads out of the fragment.
    assert (values.size(), graph.size()) == (4, 4)
    for index, pose in poses.items():
        read = values.atPose2(index)
        assert (read.x(), read.y()) == pytest.approx((pose.x, pose.y))
        assert math.cos(read.theta() - pose.theta) == pytest.approx(1.0)
    for place, link in enumerate(links[:4]):
        factor = graph.at(place)
        assert list(factor.keys()) == [link.a, link.b]
        measured = factor.measured()
        assert (measured.x(), measured.y()) == pytest.approx((link.a_from_b.x, link.a_from_b.y))
        covariance = factor.noiseModel().covariance()
        np.testing.assert_allclose(covariance, link.covariance, rtol=1e-5, atol=1e-12)


def test_links_are_listed_with_what_became_of_them(tmp_path: Path) -> None:
    link = Link(3, 4, Pose2(0.1, 0.2, 0.3), np.eye(3), 40, 0.91, "step")
    odometry = Link(4, 5, Pose2(), np.eye(3), 0, math.nan, "odometry")
    write_links(tmp_path / "links.csv", [link, odometry], {1})
    assert (tmp_path / "links.csv").read_text().splitlines() == [
        "a,b,kind,x,y,heading,inliers,score,used",
        "3,4,step,0.100000,0.200000,0.3000000,40,0.9100,yes",
        "4,5,odometry,0.000000,0.000000,0.0000000,0,,no",
    ]


def test_stitch_exports_what_it_is_asked_for(samples_folder: Path, tmp_path: Path) -> None:
    course = samples_folder / "course"
    frames = [course / "frames" / f"{index:04d}.jpg" for index in range(4)]
    arguments = ["stitch", *frames, "-c", course / "camera.yaml", "-o", tmp_path / "out"]
    refused = slam(*arguments, "--export", "tum")
    assert refused.exit_code == 1
    assert "0000.jpg has no stamp" in refused.output
    assert "--frame-rate" in refused.output
    assert slam(*arguments, "--export", "tum,bag").exit_code == 2
    asked = ["--export", "tum,kitti,g2o", "--frame-rate", "10"]
    done = slam(*arguments, *asked)
    assert done.exit_code == 0, done.output
    poses = read_trajectory(tmp_path / "out" / "poses.csv")
    tum = read_trajectory(tmp_path / "out" / "trajectory.tum")
    kitti = read_trajectory(tmp_path / "out" / "trajectory.kitti")
    assert len(tum) == 4
    np.testing.assert_allclose(tum.stamps, [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(tum.poses, poses.poses, atol=1e-6)
    np.testing.assert_allclose(kitti.poses, poses.poses, atol=1e-6)
    graph = (tmp_path / "out" / "graph.g2o").read_text()
    assert graph.count("VERTEX_SE2") == 4
    assert graph.count("EDGE_SE2") >= 3
    assert 'export = ["tum", "kitti", "g2o"]' in (tmp_path / "out" / "run.toml").read_text()
