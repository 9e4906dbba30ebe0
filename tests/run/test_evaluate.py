"""`slam evaluate`: errors known by hand, and evo's numbers on the same files."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from command_line import slam

from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2, compose_poses, pose_array, relative_poses
from slamcli.core.trajectory import Trajectory
from slamcli.io.trajectories import read_trajectory
from slamcli.stages import evaluation


def run(*arguments: object) -> Result:
    return slam("evaluate", *arguments)


def trajectory(poses: np.ndarray, **known: Any) -> Trajectory:
    fields = {"stamps": None, "names": None, "fragments": np.zeros(len(poses), int), "sigmas": None}
    return Trajectory(np.asarray(poses, float), **{**fields, **known})


def lap(count: int = 60) -> np.ndarray:
    angles = np.linspace(0.0, 6.0, count)
    return pose_array([Pose2(2 * math.sin(a), 2 - 2 * math.cos(a), a) for a in angles])


def test_errors_known_by_hand() -> None:
    truth = np.array([[float(i), 0.0, 0.0] for i in range(5)])
    estimate = truth.copy()
    estimate[:, 1] = [0.1, -0.1, 0.0, -0.1, 0.1]
    estimate[2, 2] = 0.02
    found = evaluation.evaluate(
        trajectory(compose_poses((3.0, -1.0, 0.5), estimate)),
        trajectory(truth),
        tolerance_seconds=0.01,
        delta=1,
    ).whole
    assert found.path_metres == pytest.approx(4.0)
    assert found.absolute.rmse == pytest.approx(math.sqrt(4 * 0.01 / 5))
    assert found.absolute.mean == pytest.approx(0.08)
    assert found.absolute.median == pytest.approx(0.1)
    assert found.absolute.largest == pytest.approx(0.1)
    assert found.absolute_share_of_path == pytest.approx(found.absolute.rmse / 4)
    assert found.heading.largest == pytest.approx(math.degrees(0.02))
    # From the third pose, turned by 0.02, the step ahead leads 0.02 m aside, and 0.1 m besides.
    assert found.relative.largest == pytest.approx(0.2)
    assert found.relative.mean == pytest.approx((0.2 + 0.1 + 0.2 + 0.12) / 4, abs=1e-4)


def test_sigmas_are_weighed_from_the_surest_pose() -> None:
    generator = np.random.default_rng(0)
    truth = lap(2000)
    sigmas = np.tile([0.02, 0.01, 0.005], (len(truth), 1))
    estimate = truth + sigmas * generator.standard_normal(truth.shape)
    estimate[0], sigmas[0] = truth[0], 1e-6
    world = (1.0, 2.0, -2.0)

    def nees(factor: float) -> tuple[float, float]:
        found = evaluation.evaluate(
            trajectory(estimate, sigmas=factor * sigmas),
            trajectory(compose_poses(world, truth)),
            tolerance_seconds=0.0,
            delta=1,
        ).whole.consistency
        assert found is not None
        assert found.count == 1999
        return found.nees, found.within_95_percent

    honest, within = nees(1.0)
    assert honest == pytest.approx(3.0, abs=0.2)
    assert within == pytest.approx(0.95, abs=0.02)
    assert nees(0.5)[0] == pytest.approx(4 * honest)
    assert nees(0.5)[1] < 0.6


def test_fragments_are_aligned_each_for_itself() -> None:
    truth = lap()
    fragments = np.repeat([0, 3], 30)
    estimate = truth.copy()
    estimate[30:] = compose_poses((5.0, 5.0, 1.0), estimate[30:])
    estimate[40, 0] += 0.3
    found = evaluation.evaluate(
        trajectory(estimate, fragments=fragments), trajectory(truth), tolerance_seconds=0, delta=1
    )
    first, second = found.fragments
    assert (first.fragment, second.fragment) == (0, 3)
    assert first.absolute.largest == pytest.approx(0.0, abs=1e-9)
    assert second.absolute.largest == pytest.approx(0.29, abs=0.01)
    assert found.whole.poses == 60
    assert found.whole.truth_from_map is None
    squares = 30 * second.absolute.rmse**2
    assert found.whole.absolute.rmse == pytest.approx(math.sqrt(squares / 60))
    # The jump from one fragment to the next is nobody's error.
    assert found.whole.relative.largest == pytest.approx(second.relative.largest)


def folders(path: Path, places: list[str], per_folder: int = 3) -> Path:
    """Write poses of folders whose frames have the same names; empty for one not placed."""
    rows = [
        f"000{k % per_folder}.png,{place},{place and 0},{place and 0.1}"
        for k, place in enumerate(places)
    ]
    path.write_text("\n".join(["frame,x,y,heading", *rows]) + "\n")
    return path


def test_frames_of_two_folders_with_the_same_names_are_matched_in_order(tmp_path: Path) -> None:
    truth = folders(tmp_path / "truth.csv", ["0", "1", "2", "3", "4", "5"])
    poses = folders(tmp_path / "poses.csv", ["0", "", "2", "3", "4", "5.5"])
    result = run(poses, truth, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert found["matched"] == 5
    # One is half a metre off, the others share that by the alignment.
    assert found["whole"]["absolute"]["largest"] == pytest.approx(0.4)
    alone = folders(tmp_path / "alone.csv", ["0", "1", "2"])
    result = run(alone, truth)
    assert result.exit_code == 1
    assert "no frame name in common: the poses begin with 0000.png, the truth with" in result.output
    assert "0000.png (1 of 2)" in result.output


def test_poses_are_matched_by_stamps_else_names_else_order() -> None:
    poses = lap(6)
    stamps = np.arange(6.0)
    names = tuple("abcdef")
    truth = trajectory(poses, stamps=stamps, names=names)
    early = trajectory(poses[[1, 2, 4]], stamps=np.array([1.004, 1.9, 4.0]), names=("x", "y", "z"))
    by, ours, theirs = evaluation.match_poses(early, truth, 0.01)
    assert (by, ours.tolist(), theirs.tolist()) == ("stamps", [0, 2], [1, 4])
    # A moment is used once, by the nearest.
    crowd = trajectory(poses[:3], stamps=np.array([2.0, 2.006, 2.001]))
    _, ours, theirs = evaluation.match_poses(
        crowd, trajectory(poses[:4], stamps=np.array([2.0001, 5.0, 6.0, 7.0])), 0.01
    )
    assert (ours.tolist(), theirs.tolist()) == ([0], [0])
    unstamped = trajectory(poses[[4, 0]], names=("e", "a"))
    by, ours, theirs = evaluation.match_poses(unstamped, truth, 0.01)
    assert (by, ours.tolist(), theirs.tolist()) == ("frame names", [0, 1], [4, 0])
    assert evaluation.match_poses(trajectory(poses), trajectory(poses), 0.01)[0] == "order"
    with pytest.raises(InputError, match="span 100"):
        evaluation.match_poses(trajectory(poses, stamps=stamps + 100), truth, 0.01)
    with pytest.raises(InputError, match="5 poses and 6 true ones"):
        evaluation.match_poses(trajectory(poses[:5]), trajectory(poses), 0.01)


def write_tum(path: Path, stamps: np.ndarray, poses: np.ndarray) -> None:
    rows = [
        f"{s!r} {x!r} {y!r} 0.0 0.0 0.0 {math.sin(a / 2)!r} {math.cos(a / 2)!r}"
        for s, (x, y, a) in zip(stamps.tolist(), poses.tolist(), strict=True)
    ]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize("delta", [1, 3])
def test_evo_measures_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, delta: int) -> None:
    # evo writes its settings into the home folder when it is first imported.
    monkeypatch.setenv("HOME", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("evo")
        from evo.core import metrics, sync
        from evo.tools import file_interface

        generator = np.random.default_rng(5)
        truth = lap(200)
        stamps = 1446412345.0 + 0.1 * np.arange(200)
        steps = relative_poses(truth[:-1], truth[1:])
        steps += generator.normal(0, (0.002, 0.002, 0.004), steps.shape)
        estimate = [np.array([4.0, 1.0, 2.5])]
        for step in steps:
            estimate.append(compose_poses(estimate[-1], step))
        seen = np.sort(generator.choice(200, 150, replace=False))
        jitter = generator.uniform(-0.008, 0.008, 150)
        write_tum(tmp_path / "truth.tum", stamps, truth)
        write_tum(tmp_path / "poses.tum", stamps[seen] + jitter, np.array(estimate)[seen])

        reference = file_interface.read_tum_trajectory_file(str(tmp_path / "truth.tum"))
        other = file_interface.read_tum_trajectory_file(str(tmp_path / "poses.tum"))
        reference, other = sync.associate_trajectories(reference, other, max_diff=0.01)
        other.align(reference)
        expected = {}
        for name, relation in (
            ("absolute", metrics.PoseRelation.translation_part),
            ("heading", metrics.PoseRelation.rotation_angle_deg),
        ):
            absolute = metrics.APE(relation)
            absolute.process_data((reference, other))
            expected[name] = absolute.get_all_statistics()
            relative = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames)
            relative.process_data((reference, other))
            key = "relative" if name == "absolute" else "relative_heading"
            expected[key] = relative.get_all_statistics()
    result = run(tmp_path / "poses.tum", tmp_path / "truth.tum", "--json", "--delta", delta)
    assert result.exit_code == 0, result.output
    found = json.loads(result.output)
    assert found["matched"] == reference.num_poses == 150
    assert found["whole"]["path_metres"] == pytest.approx(reference.path_length, abs=1e-6)
    for name, statistics in expected.items():
        ours = found["whole"][name]
        for key, evos in (("rmse", "rmse"), ("mean", "mean"), ("median", "median")):
            assert ours[key] == pytest.approx(statistics[evos], abs=1e-6), (name, key)
        assert ours["largest"] == pytest.approx(statistics["max"], abs=1e-6), name
        assert statistics["rmse"] > 1e-3


def test_every_format_says_the_same(tmp_path: Path) -> None:
    poses = lap(12)
    stamps = np.arange(12) / 10
    write_tum(tmp_path / "a.txt", stamps, poses)
    turned = [(math.cos(a), -math.sin(a), x, math.sin(a), math.cos(a), y) for x, y, a in poses]
    (tmp_path / "b.txt").write_text(
        "".join(f"{c} {s} 0 {x} {n} {d} 0 {y} 0 0 1 0\n" for c, s, x, n, d, y in turned)
    )
    rows = [
        f"f{i},{s},{x},{y},{math.degrees(a)}"
        for i, (s, (x, y, a)) in enumerate(zip(stamps, poses, strict=True))
    ]
    (tmp_path / "c.csv").write_text("\n".join(["Frame, Time, X, Y, Yaw_deg", *rows, "f12,1.2,,,"]))
    tum, kitti, table = (read_trajectory(tmp_path / name) for name in ("a.txt", "b.txt", "c.csv"))
    for read in (tum, kitti, table):
        np.testing.assert_allclose(
            read.poses, poses - [0, 0, math.tau] * (poses[:, 2:] > math.pi), atol=1e-12
        )
    np.testing.assert_allclose(tum.stamps, stamps)
    np.testing.assert_allclose(table.stamps, stamps)
    assert kitti.stamps is None
    assert table.names == tuple(f"f{i}" for i in range(12))
    assert table.unplaced == 1


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty"),
        ("x,heading\n1,2\n", "has no column y; its header is x, heading"),
        ("x,y,heading\n0,0,0\n1,b,0\n", "line 3: y is 'b'"),
        ("x,y,heading\n0,0,0\n1,,0\n", "line 3: x, y, heading must be numbers"),
        ("x,y,heading\n0,0,0,7\n", "line 2: 4 fields under a header of 3"),
        ("0 1 2\n", "line 1: 3 fields without a header"),
        ("0 1 2 0 0 0 0 1\n0 1 2 0 0 0 0\n", "line 2: 8 numbers are needed"),
        ("0 1 2 0 0 0 0 1\n0 1 2 0 0 0 0 nan\n", "line 2: a number is not finite"),
        ("0 1 2 0 0 0 0 2\n", "line 1: the quaternion is not of length 1"),
        ("0 1 2 0 0.7071 0 0 0.7071\n", "leans by more than 15 degrees"),
        ("1 0 0 5 0 0 -1 6 0 1 0 7\n", "z must point up"),
        ("frame,x,y,heading\na,,,\n", "has no frame with a pose"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "poses").write_text(content)
    (tmp_path / "truth.csv").write_text("frame,x,y,heading\na,0,0,0\n")
    result = run(tmp_path / "poses", tmp_path / "truth.csv")
    assert result.exit_code == 1
    assert len(result.output.strip().splitlines()) == 1
    assert words in result.output
    assert "poses" in result.output


def test_words_tell_each_fragment_and_the_whole(samples_folder: Path, tmp_path: Path) -> None:
    lines = (samples_folder / "course" / "truth.csv").read_text().splitlines()
    rows = [f"{line},{int(index >= 20)},1e-3,1e-3,1e-3" for index, line in enumerate(lines[1:])]
    header = lines[0] + ",fragment,sigma_x,sigma_y,sigma_heading"
    (tmp_path / "poses.csv").write_text("\n".join([header, *rows]))
    result = run(tmp_path / "poses.csv", samples_folder / "course" / "truth.csv")
    assert result.exit_code == 0
    for words in ("40 poses of 40 true ones", "fragment 1", "all fragments", "NEES", "ATE"):
        assert words in result.output
    same = run(samples_folder / "course" / "truth.csv", samples_folder / "course" / "truth.csv")
    assert "fragment" not in same.output
    assert "NEES" not in same.output


def test_one_matched_pair_is_no_error_of_zero(tmp_path: Path) -> None:
    """An alignment by one pose would make any pose right."""
    (tmp_path / "poses.csv").write_text("frame,x,y,heading\na,5,7,1\nb,,,\n")
    (tmp_path / "truth.csv").write_text("frame,x,y,heading\na,0,0,0\nb,1,0,0\n")
    result = run(tmp_path / "poses.csv", tmp_path / "truth.csv")
    assert result.exit_code == 0
    assert "ATE           too few poses" in result.output
    found = json.loads(run(tmp_path / "poses.csv", tmp_path / "truth.csv", "--json").output)
    assert found["whole"]["absolute"]["rmse"] is None


def test_several_are_compared_with_one_truth_as_text_table_and_plot(
    samples_folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    truth = samples_folder / "course" / "truth.csv"
    lines = truth.read_text().splitlines()
    shifted = [line.split(",") for line in lines[1:]]
    for number, row in enumerate(shifted):
        row[3] = str(float(row[3]) + (0.003 if number % 2 else -0.003))
    rows = [",".join([*row, "0.002", "0.002", "0.01"]) for row in shifted]
    header = lines[0] + ",sigma_x,sigma_y,sigma_heading"
    (tmp_path / "a_b.csv").write_text("\n".join([header, *rows]))
    outputs = []
    for suffix in ("pdf", "svg", "png", "pdf"):
        arguments = (truth, tmp_path / "a_b.csv", "--truth", truth, "--overwrite")
        plot, table = tmp_path / f"out.{suffix}", tmp_path / "out.tex"
        result = run(*arguments, "--plot", plot, "--table", table)
        assert result.exit_code == 0, result.output
        outputs.append(plot.read_bytes())
    assert outputs[0].startswith(b"%PDF")
    assert outputs[0] == outputs[3]
    assert outputs[2].startswith(b"\x89PNG")
    latex = (tmp_path / "out.tex").read_text()
    assert r"a\_b.csv & 40 & 0 & 3.117 & " in latex
    assert run(truth, tmp_path / "a_b.csv", "--truth", truth, "--table", tmp_path / "t.csv")
    table = (tmp_path / "t.csv").read_text().splitlines()
    # 3 mm to and fro are an error of 3 mm, which the alignment cannot take away.
    assert float(table[2].split(",")[4]) == pytest.approx(3.0, rel=0.02)
    assert float(table[1].split(",")[4]) == 0.0
    data = json.loads(run(truth, tmp_path / "a_b.csv", "--truth", truth, "--json").output)
    assert len(data) == 2


def test_errors_lie_along_the_truths_path_in_its_order() -> None:
    poses = np.array([(2.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.004, 0.0), (9.0, 9.0, 0.0)])
    truth = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 5.0, 0.0)])
    sigmas = np.full((4, 3), 0.003)
    estimate = Trajectory(poses, None, ("c", "a", "b", "d"), np.array([0, 0, 0, 1]), sigmas)
    true = Trajectory(truth, None, ("a", "b", "c", "d"), np.zeros(4, np.int64), None)
    found = evaluation.error_series("x", estimate, true, 0.01)
    np.testing.assert_allclose(found.path_metres, [0.0, 1.0, 2.0, 7.0])
    assert found.errors_metres[:3].max() == pytest.approx(0.004 * 2 / 3, rel=0.01)
    assert np.isnan(found.errors_metres[3])
    np.testing.assert_allclose(found.sigmas_metres, np.sqrt(2) * 0.003)


def test_a_folder_of_tum_stands_for_its_ground_truth(tmp_path: Path) -> None:
    (tmp_path / "groundtruth.txt").write_text("# ground truth\n0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    result = run(tmp_path / "poses.txt", tmp_path)
    assert result.exit_code == 0, result.output
    assert "2 poses of 2 true ones" in result.output


def test_the_folder_of_a_run_stands_for_its_poses(samples_folder: Path, tmp_path: Path) -> None:
    course = samples_folder / "course"
    (tmp_path / "poses.csv").write_bytes((course / "truth.csv").read_bytes())
    result = run(tmp_path, course)
    assert result.exit_code == 0, result.output
    assert "40 poses of 40 true ones" in result.output
    replacing = run(tmp_path, course, "--table", tmp_path / "poses.csv", "--overwrite")
    assert "it is an input of this command" in replacing.output
    (tmp_path / "truth.csv").write_text("")
    assert "several files of poses, poses.csv and truth.csv" in run(tmp_path, course).output
    assert "has no file of poses: poses.csv" in run(course / "frames", course).output


def test_what_cannot_be_written_is_refused_first(samples_folder: Path, tmp_path: Path) -> None:
    truth = samples_folder / "course" / "truth.csv"
    result = run(truth, truth, "--plot", tmp_path / "out.gif")
    assert result.exit_code == 1
    assert "give a name that ends in .pdf or .svg or .png" in result.output
    (tmp_path / "t.csv").write_text("")
    result = run(truth, truth, "--table", tmp_path / "t.csv")
    assert result.exit_code == 1
    assert "--overwrite" in result.output
