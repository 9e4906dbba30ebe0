"""ALIKED, DISK and LightGlue from ONNX files: points in place, one line for a bad file."""

from __future__ import annotations

import csv
import json
import math
import tomllib
from dataclasses import replace

import cv2
import floor_pictures
import numpy as np
import pytest
import tiny_networks
from command_line import slam

from slamcli.core.config import FeatureOptions, MatchOptions
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.records import View
from slamcli.io.files import write_image
from slamcli.io.networks import load_match_network, load_point_network
from slamcli.stages import align, features

SIZE = (tiny_networks.SIDE, tiny_networks.SIDE)
MOTION = Pose2(30.3, -20.6, math.radians(5.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Networks and two pictures of one floor: content moved by `MOTION`, in axes x right, y up."""
    folder = tmp_path_factory.mktemp("networks")
    for method in ("aliked", "disk"):
        tiny_networks.write_points(folder / f"{method}.onnx", method)
    tiny_networks.write_glue(folder / "lightglue.onnx")
    (folder / "text.onnx").write_text("no network")
    floor = coarse_floor()
    for name, pose in (("a.png", Pose2()), ("b.png", MOTION)):
        write_image(folder / name, floor_pictures.look(floor, pose).image)
    return folder


def coarse_floor():
    """Texture that is still there at less than half the resolution."""
    return cv2.resize(floor_pictures.asphalt(500), None, fx=2.4, fy=2.4)


def options_of(folder, method):
    network = load_point_network(method, folder / f"{method}.onnx", SIZE)
    return FeatureOptions(method=method, network=network)


@pytest.mark.parametrize("method", ["aliked", "disk"])
def test_points_are_placed_in_the_view_whatever_its_shape(folder, method):
    view = floor_pictures.look(coarse_floor(), Pose2(), noise=0.0)
    # White discs on plain gray, in a view twice as wide as high.
    image = np.full((300, 600), 90, np.uint8)
    places = np.array([[80.0, 60.0], [333.0, 150.0], [520.0, 240.0]])
    for x, y in places:
        cv2.circle(image, (round(16 * x), round(16 * y)), 16 * 4, 230, -1, cv2.LINE_AA, 4)
    view = View(replace(view.grid, width=600, height=300), image, np.full_like(image, 255))
    found = features.detect(view, replace(options_of(folder, method), count=3, spread=False))
    errors = np.abs(found.pixels[:, None] - places[None]).max(axis=2).min(axis=0)
    # The network's pixel spans 600 / 256 of the view's.
    assert errors.max() < 1.3
    assert found.descriptors.shape == (3, tiny_networks.DIMENSIONS)
    mask = view.mask.copy()
    mask[:, :200] = 0
    kept = features.detect(replace(view, mask=mask), options_of(folder, method))
    assert len(kept) > 0
    assert kept.pixels[:, 0].min() > 200


@pytest.mark.parametrize("method", ["aliked", "disk"])
def test_a_known_motion_comes_back(folder, method):
    floor = coarse_floor()
    options = options_of(folder, method)
    a, b = (
        features.extract(floor_pictures.look(floor, pose), floor_pictures.top_down(), options)
        for pose in (Pose2(), MOTION)
    )
    glue = load_match_network(folder / "lightglue.onnx")
    for matching in (MatchOptions(), MatchOptions(network=glue)):
        found = align.align(a, b, matching)
        assert found.accepted, found.reason
        error = MOTION.inverse() @ found.pose
        assert error.translation_length < 0.5
        assert abs(math.degrees(error.theta)) < 0.1
        assert found.inlier_count > 40


def test_a_network_pairs_only_what_a_guess_allows(folder):
    floor = coarse_floor()
    options = options_of(folder, "aliked")
    a, b = (
        features.extract(floor_pictures.look(floor, pose), floor_pictures.top_down(), options)
        for pose in (Pose2(), MOTION)
    )
    matching = MatchOptions(network=load_match_network(folder / "lightglue.onnx"), search_radius=5)
    pairs, distances = align.match_descriptors(a, b, matching, MOTION.matrix)
    apart = a.points[pairs[:, 0]] - MOTION.apply(b.points[pairs[:, 1]])
    assert len(pairs) > 40
    assert np.hypot(*apart.T).max() < 50.0
    assert len(np.unique(pairs[:, 1])) == len(pairs)
    assert 0.0 <= distances.min() <= distances.max() <= 0.9
    elsewhere = Pose2(400.0, 400.0).matrix
    assert len(align.match_descriptors(a, b, matching, elsewhere)[0]) < 0.1 * len(pairs)


def test_the_commands_take_the_files(folder, tmp_path):
    point = ("--features", "aliked", "--weights", folder / "aliked.onnx")
    point += ("--network-size", "256x256")
    glue = ("--matcher", "lightglue", "--matcher-weights", folder / "lightglue.onnx")
    result = slam("match", folder / "a.png", folder / "b.png", *point, *glue, "--json")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    # Image axes: y down, so a turn to the left of the camera turns the picture by its opposite.
    assert facts["rotation_degrees"] == pytest.approx(5.0, abs=0.2)
    assert facts["features"]["method"] == "ALIKED"
    detected = slam("detect", folder / "a.png", "-o", tmp_path / "found", *point)
    assert "ALIKED points" in detected.stdout
    frames = tmp_path / "frames"
    frames.mkdir()
    for name in ("a.png", "b.png"):
        (frames / name).write_bytes((folder / name).read_bytes())
    maps = []
    for workers in (1, 2):
        output = tmp_path / f"map{workers}"
        done = slam("stitch", frames, "-o", output, *point, *glue, "--workers", workers)
        assert done.exit_code == 0, done.output
        maps.append((output / "poses.csv").read_bytes())
    assert maps[0] == maps[1]
    rows = list(csv.DictReader(maps[0].decode().splitlines()))
    assert [row["status"] for row in rows] == ["tracked", "tracked"]
    recorded = tomllib.loads((tmp_path / "map1" / "run.toml").read_text(encoding="utf-8"))
    assert recorded["options"]["networks"]["weights"] == str(folder / "aliked.onnx")


def test_a_map_of_learned_features_is_rendered_but_not_located_in(folder, tmp_path):
    frames, output = tmp_path / "frames", tmp_path / "map"
    frames.mkdir()
    for name in ("a.png", "b.png"):
        (frames / name).write_bytes((folder / name).read_bytes())
    point = ("--features", "aliked", "--weights", folder / "aliked.onnx")
    done = slam("stitch", frames, "-o", output, *point, "--network-size", "256x256")
    assert done.exit_code == 0, done.output
    assert "do not take aliked" in done.stdout
    again = slam("render", output, "-o", tmp_path / "again")
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again" / "mosaic.pgw").read_bytes() == (output / "mosaic.pgw").read_bytes()
    for words in (
        ("locate", output, frames),
        ("stitch", folder / "a.png", "--extend", output, "-o", tmp_path / "no"),
    ):
        result = slam(*words)
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert "ALIKED features" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--features", "aliked"), "--weights"),
        (("--features", "disk", "--weights", "missing.onnx"), "No such file"),
        (("--features", "aliked", "--weights", "text.onnx"), "not a network"),
        (("--features", "disk", "--weights", "text.onnx"), "not a network"),
        (("--features", "disk", "--weights", "."), "directory"),
        (("--features", "orb", "--weights", "aliked.onnx"), "not orb"),
        (("--features", "aliked", "--weights", "lightglue.onnx"), "does not work as ALIKED"),
        (
            ("--features", "disk", "--weights", "disk.onnx", "--network-size", "100x100"),
            "multiples of 16",
        ),
        (("--features", "orb", "--matcher", "lightglue"), "--matcher-weights"),
        (("--features", "orb", "--matcher-weights", "lightglue.onnx"), "--matcher lightglue"),
        (
            ("--features", "orb", "--matcher", "lightglue", "--matcher-weights", "lightglue.onnx"),
            "aliked or disk",
        ),
        (
            (
                *("--features", "aliked", "--weights", "aliked.onnx", "--network-size", "256x256"),
                *("--matcher", "lightglue", "--matcher-weights", "disk.onnx"),
            ),
            "does not work as LightGlue",
        ),
    ],
)
def test_a_file_that_does_not_serve_is_one_line(folder, monkeypatch, arguments, said):
    monkeypatch.chdir(folder)
    result = slam("match", "a.png", "b.png", *arguments)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert said in result.stderr


def test_learned_points_without_a_network_are_refused():
    view = floor_pictures.look(floor_pictures.asphalt(700), Pose2())
    with pytest.raises(InputError, match="ALIKED"):
        features.detect(view, FeatureOptions(method="aliked"))


@pytest.mark.parametrize("method", ["orb", "sift"])
def test_upright_descriptors_serve_small_turns_and_not_large_ones(method):
    floor = floor_pictures.asphalt(1200)
    counts = {}
    # Scale-space points cost most of the time, and one turn tells enough of them.
    for degrees in (3.0, 60.0) if method == "orb" else (3.0,):
        motion = Pose2(12.0, -7.0, math.radians(degrees))
        for upright in (False, True):
            options = FeatureOptions(method=method, upright=upright)
            a, b = (
                features.extract(
                    floor_pictures.look(floor, pose, noise=8.0, seed=seed),
                    floor_pictures.top_down(),
                    options,
                )
                for seed, pose in enumerate((Pose2(), motion))
            )
            counts[degrees, upright] = align.align(a, b, MatchOptions()).inlier_count
    assert counts[3.0, True] > counts[3.0, False]
    if method == "orb":
        assert counts[60.0, True] < 20 < counts[60.0, False]
