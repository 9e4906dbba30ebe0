"""`slam render`: a finished map painted again from its map.slam alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamcli.cli.main import main
from slamcli.io.map_file import load_map, save_map

COARSE = ("--metres-per-pixel", "0.005")


def run(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.fixture(scope="module")
def drive(samples_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames in `frames`, and their map in `out`."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "frames").mkdir()
    for number in range(3):
        shutil.copy(samples_folder / "course" / "frames" / f"{number:04d}.jpg", folder / "frames")
    square = samples_folder / "course" / "square.png"
    assert run("calibrate", square, "-o", folder / "calibration.yaml").exit_code == 0
    calibration = folder / "calibration.yaml"
    result = run("stitch", folder / "frames", "-c", calibration, "-o", folder / "out", *COARSE)
    assert result.exit_code == 0, result.output
    return folder


def test_the_map_alone_is_rendered(drive: Path, tmp_path: Path) -> None:
    """Nothing but map.slam is read of the earlier run, and the same bytes are painted."""
    alone = tmp_path / "alone"
    shutil.copytree(drive / "out", alone)
    for name in ("run.toml", "poses.csv"):
        (alone / name).unlink()
    mosaics = [(drive / "out" / "mosaic.png").read_bytes()]
    for number, named in enumerate((drive / "out", alone, alone / "map.slam", alone / "x.png")):
        result = run("render", named, "-o", tmp_path / str(number), *COARSE)
        assert result.exit_code == 0, result.output
        mosaics.append((tmp_path / str(number) / "mosaic.png").read_bytes())
    assert len(set(mosaics)) == 1


def test_a_map_that_does_not_record_its_frames_needs_to_be_given_them(
    drive: Path, tmp_path: Path
) -> None:
    path = tmp_path / "old.slam"
    save_map(path, replace(load_map(drive / "out"), sources=()))
    result = run("render", path, "-o", tmp_path / "out", *COARSE)
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "old.slam does not record where its frames are" in result.output
    assert "--frames" in result.output
    given = run("render", path, "--frames", drive / "frames", "-o", tmp_path / "out", *COARSE)
    assert given.exit_code == 0, given.output


def test_frames_that_are_gone_are_named(drive: Path, tmp_path: Path) -> None:
    path = tmp_path / "moved.slam"
    save_map(path, replace(load_map(drive / "out"), sources=(tmp_path / "gone",)))
    result = run("render", path, "-o", tmp_path / "out", *COARSE)
    assert result.exit_code == 1
    assert "gone, where" in result.output
    assert "--frames" in result.output
