"""Boundary values of every numeric option and every field of a table, each run wholly in a child.

Run: python tests/robustness/boundaries.py FOLDER [--match TEXT] [--part I/N]. The work is real, of
a drive of three small frames, in a child of bounded memory and time that is forked after the
imports. One row is written for each value; a list that is cut off goes on after its last row.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import itertools
import math
import os
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import cv2

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import numpy as np  # noqa: E402
from fuzz import MAX_ADDRESS_BYTES, MAX_BYTES, MAX_SECONDS  # noqa: E402
from spied_commands import WORK, flag_of  # noqa: E402
from test_option_values import OPTIONS  # noqa: E402
from worlds import make_photographer, take  # noqa: E402

from slamcli.cli.main import main as slam  # noqa: E402
from slamcli.cli.options.values import Bytes, Degrees, Numbers  # noqa: E402
from slamcli.core.bounds import Bounds  # noqa: E402
from slamcli.core.errors import SlamcliError  # noqa: E402
from slamcli.core.geometry import Pose2  # noqa: E402
from slamcli.io.calibrations import load_calibration, save_calibration  # noqa: E402
from slamcli.simulation.config import CameraOptions  # noqa: E402

FRAMES = 3
# A child that waits for a processor is not hung, and one that shows progress is at work: it is
# ended after this many seconds, of its processor's time and of the clock.
_MAX_WORK_SECONDS, _MAX_CLOCK_SECONDS = 30.0, 600.0
_TICKS = os.sysconf("SC_CLK_TCK")
OUTCOMES = ("clean", "reason", "at work", "traceback", "hang", "memory", "silent wrong")
_FAULTS = frozenset(OUTCOMES[3:])
_SQUARE = HERE.parents[1] / "samples" / "course" / "square.png"
_DRIVE = ["stitch", "frames", "-o", "out"]
_SENSORS = ["--odometry", "odometry.csv", "--compass", "compass.csv", "--gps", "gps.csv"]
# How each command is called, and what else an option needs to have a meaning.
COMMANDS = {
    "stitch": _DRIVE,
    # A camera that no machine has: only the options are tried.
    "live": ["live", "999", "--no-browser"],
    "locate": ["locate", "map", "frames/1.png", "-o", "out.csv"],
    "render": ["render", "map", "-o", "out"],
    "warp": ["warp", "frames", "-o", "out"],
    "detect": ["detect", "frames", "-o", "out"],
    "match": ["match", "frames/0.png", "frames/1.png", "-o", "out.png"],
    "extract": ["extract", "drive.avi", "-o", "out"],
    "view": ["view", "map", "--no-browser"],
    "evaluate": ["evaluate", "poses.csv", "poses.csv", "--json"],
    "calibrate": ["calibrate", str(_SQUARE), "-o", "out.yaml"],
    "simulate": [
        *("simulate", "out", "--no-light", "--frames", "2", "--size", "64x64"),
        *("--length", "0.1", "--workers", "1"),
    ],
}
_OF_VIDEOS = frozenset({"--every", "--fps", "--from", "--to"})
_NAV, _GEOTIFF = ["--format", "nav2"], ["--format", "geotiff"]
BESIDE = {
    "--nav-resolution": _NAV,
    "--datum": _GEOTIFF,
    "--time-offset": _SENSORS,
    "--lever-arm": _SENSORS,
    "--odometry-sigma": _SENSORS,
    "--contrast-threshold": ["--features", "sift"],
    "--tile": ["--floor", "tiles"],
    "--grout": ["--floor", "tiles"],
    "--marks": ["--floor", "tiles"],
}
TABLES = {
    "odometry.csv": "stamp,x,y,heading\n0,0,0,0\n0.1,0.02,0,0\n0.2,0.04,0,0\n0.3,0.06,0,0\n",
    "compass.csv": "stamp,heading,sigma\n0,0.5,0.05\n0.1,0.5,0.05\n0.2,0.5,0.05\n",
    "gps.csv": (
        "stamp,latitude,longitude,sigma\n0,29.6,-82.3,1\n0.1,29.6,-82.3,1\n0.2,29.6,-82.3,1\n"
    ),
    "poses.csv": (
        "index,frame,stamp,status,fragment,x,y,heading,sigma_x,sigma_y,sigma_heading\n"
        "0,0.png,0,tracked,0,0,0,0,1e-3,1e-3,1e-3\n1,1.png,0.1,tracked,0,1,0,0,1e-3,1e-3,1e-3\n"
        "2,2.png,0.2,tracked,0,2,0,0.1,1e-3,1e-3,1e-3\n"
    ),
}
_TEXTS = {"frame", "status"}
FIELD_VALUES = (
    *("nan", "inf", "-inf", "1e300", "-1e300", "1e18", "-1e18", "1e-300", "1e-18", "1e-6", "0"),
    *("-1", "1e3", "1e6", "1e7", "-1e7", "1e9", "1e12", "90", "180", "", "text", "9" * 400),
)
CALIBRATION_VALUES = ("nan", "inf", "0", "-1", "1e-300", "1e-9", "1e3", "1e9", "1e300", "text")


class Case(NamedTuple):
    """A command with one extreme value, in an option or in a file that it reads."""

    name: str
    words: list[str]
    files: dict[str, str]


class Outcome(NamedTuple):
    """A row of the table."""

    name: str
    kind: str
    seconds: float
    megabytes: float
    text: str


def numbers_about(limits: Bounds) -> list[float]:
    """Return numbers at bounds, beyond them, and between."""
    low, high = limits.low, limits.high
    step = 1.0 if limits.whole else 1e-3 * (high - low)
    between = np.linspace(low, high, 5)[1:-1]
    if low > 0.0 and high > 1e3 * low:
        between = np.geomspace(low, high, 8)[1:-1]
    found = [low, high, low - step, high + step, *between.tolist()]
    return [float(int(n)) for n in found] if limits.whole else found


def option_cases() -> Iterator[Case]:
    """Yield the options' values."""
    for command, parameter in OPTIONS:
        kind, flag = parameter.type, flag_of(parameter)
        words = [*COMMANDS[command], *BESIDE.get(flag, [])]
        if (command, flag) == ("stitch", "--height"):
            words = ["stitch", "plain", "-o", "out"]
        if command == "stitch" and flag in _OF_VIDEOS:
            words = ["stitch", "drive.avi", "-c", "frames/calibration.yaml", "-o", "out"]
        texts: list[str]
        if isinstance(kind, Bytes):
            texts = ["0", "1M", "999k", "1000T", "1001T", "20M", "100G"]
        else:
            limits: Bounds = Degrees.limits if isinstance(kind, Degrees) else kind.limits
            numbers = numbers_about(limits)
            texts = [f"{n:.0f}" if limits.whole else repr(n) for n in numbers]
        if isinstance(kind, Numbers):
            texts = list(_groups(kind, texts))
        for text in texts:
            yield Case(f"{command} {flag}={text[:60]}", [*words, f"{flag}={text}"], {})


def _groups(kind: Numbers, texts: list[str]) -> Iterator[str]:
    """Yield groups of numbers: each place of them extreme alone, and all of them."""
    good = "100" if kind.limits.whole else "1"
    count = kind.counts[-1]
    for text in texts:
        for place in (*range(count), None):
            group = [text if place in {None, k} else good for k in range(count)]
            yield " ".join([kind.separator.join(group)] * kind.groups)


def field_cases() -> Iterator[Case]:
    """Yield the values of the tables' fields and of the calibration's numbers."""
    for name, table in TABLES.items():
        rows = [line.split(",") for line in table.split()]
        command = COMMANDS["evaluate"] if name == "poses.csv" else [*_DRIVE, *_SENSORS]
        for column, value in itertools.product(range(len(rows[0])), FIELD_VALUES):
            if rows[0][column] in _TEXTS:
                continue
            for line in (1, len(rows) - 1):
                changed = [list(row) for row in rows]
                changed[line][column] = value
                text = "\n".join(",".join(row) for row in changed) + "\n"
                label = f"{name} {rows[0][column]}, line {line + 1}: {value[:20]}"
                yield Case(label, command, {name: text})
    lines = Path("frames/calibration.yaml").read_text().splitlines()
    for number, line in enumerate(lines):
        key, _, content = line.partition(": ")
        if not content or content.startswith("#"):
            continue
        for value in CALIBRATION_VALUES:
            first, comma, rest = content.strip("[]").partition(",")
            text = f"[{value}{comma}{rest}]" if content.startswith("[") else value
            if text == first:
                continue
            yaml = "\n".join([*lines[:number], f"{key}: {text}", *lines[number + 1 :]])
            label = f"calibration, line {number + 1} {key.strip()}: {value}"
            yield Case(label, ["warp", "frames", "-c", "c.yaml", "-o", "out"], {"c.yaml": yaml})


def set_up() -> None:
    """Write the inputs into the current folder."""
    photographer = make_photographer(
        camera=CameraOptions(size=(160, 120), height_metres=0.2, pitch_degrees=45.0)
    )
    for folder in ("frames", "plain"):
        Path(folder).mkdir(exist_ok=True)
        for number in range(FRAMES):
            picture = take(photographer, Pose2(0.02 * number), number)
            cv2.imwrite(f"{folder}/{number}.png", picture)
    save_calibration(Path("frames/calibration.yaml"), photographer.calibration)
    video = cv2.VideoWriter("drive.avi", cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (160, 120))
    for number in range(FRAMES):
        video.write(take(photographer, Pose2(0.02 * number), number))
    video.release()
    for name, text in TABLES.items():
        Path(name).write_text(text)
    if not Path("map").exists():
        _call(["stitch", "frames", "-o", "map", "--frame-rate", "10"])


def _call(words: list[str]) -> int:
    try:
        slam(words, prog_name="slam")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def outcome_of(case: Case) -> Outcome:
    """Run a case in a child, in the current folder."""
    for old in Path().glob("out*"):
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    for name, text in case.files.items():
        Path(name).write_text(text)
    log, started = Path("said.txt"), time.monotonic()
    child = os.fork()
    if child == 0:
        _child(case.words, log)
    limit = 3.0 * MAX_SECONDS if case.words[0] == "view" else _MAX_CLOCK_SECONDS
    status, usage, silent_seconds = _wait(child, started + limit, log)
    seconds, said = usage.ru_utime + usage.ru_stime, log.read_text(errors="replace")
    for name in case.files:
        if name in TABLES:
            Path(name).write_text(TABLES[name])
    kind, text = _kind(case, status, said)
    if silent_seconds > MAX_SECONDS:
        kind = "hang"
    if usage.ru_maxrss * 1024 > MAX_BYTES:
        kind = "memory"
    return Outcome(case.name, kind, round(seconds, 2), round(usage.ru_maxrss / 1024, 1), text)


def _child(words: list[str], log: Path) -> None:
    code = 70
    try:
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(descriptor, stream)
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESS_BYTES, MAX_ADDRESS_BYTES))
        seconds = math.ceil(_MAX_WORK_SECONDS)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        code = _call(words)
    except BaseException:  # noqa: BLE001 - whatever it is, it ended the command
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(child: int, deadline: float, log: Path) -> tuple[int, Any, float]:
    """Return the status and the resources of a child, and how long it printed nothing.

    That is in seconds of its processor's time; a child that is silent for too long is killed.
    """
    printed, since, longest = 0, 0.0, 0.0
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return status, usage, longest
        seconds = _processor_seconds(child)
        size = log.stat().st_size if log.exists() else 0
        if size != printed:
            printed, since = size, seconds
        longest = max(longest, seconds - since)
        if longest > MAX_SECONDS or time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.01)


def _processor_seconds(process: int) -> float:
    """Return the processor's time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _kind(case: Case, status: int, said: str) -> tuple[str, str]:
    lines = said.splitlines()
    last = lines[-1] if lines else ""
    if "Traceback" in said:
        return "traceback", said[-1500:]
    if os.WIFSIGNALED(status):
        if os.WTERMSIG(status) not in {signal.SIGXCPU, signal.SIGKILL}:
            return "traceback", f"signal {os.WTERMSIG(status)}: {last}"
        return ("at work" if _works(case, said) else "hang"), last
    code = os.WEXITSTATUS(status)
    if code in {1, 2}:
        told = sum(line.startswith("Error: ") for line in lines) == 1 and len(said) < 2000
        return ("reason", last) if told else ("silent wrong", f"no reason: {said[-500:]}")
    if code not in {0, 3}:
        return "traceback", f"exit code {code}: {last}"
    try:
        fault = _fault(case.words)
    except (OSError, ValueError, SlamcliError) as error:
        fault = f"what was written cannot be read: {error}"
    return ("silent wrong", fault) if fault else ("clean", last)


def _works(case: Case, said: str) -> bool:
    """Return whether a command that was asked for much, or for ever, does it."""
    return "http://" in said if case.words[0] == "view" else "taking frames" in said


def _fault(words: list[str]) -> str:
    """Return what is wrong with the results of a command that has ended well."""
    command, out = words[0], Path("out")
    if command == "stitch":
        return _fault_of_map(words, out)
    if command == "render" and not _has_map(out):
        return "no map"
    if command in {"warp", "detect"}:
        pictures = [cv2.imread(str(path)) for path in out.glob("*.png")]
        if sum(picture is not None for picture in pictures) != FRAMES:
            return f"{len(pictures)} pictures"
    if command == "simulate" and not any((out / "frames").iterdir()):
        return "no frames"
    if command == "calibrate":
        load_calibration(Path("out.yaml"))
    return ""


def _fault_of_map(words: list[str], out: Path) -> str:
    with (out / "poses.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    if len(rows) != FRAMES and "drive.avi" not in words:
        return f"{len(rows)} rows in poses.csv"
    numbers = [float(row[name]) for row in rows for name in ("x", "y", "heading") if row["x"]]
    if not all(map(math.isfinite, numbers)):
        return "poses that are not finite"
    return "placed, but there is no map" if numbers and not _has_map(out) else ""


def _has_map(out: Path) -> bool:
    """Return whether there is a map, in one of the formats, that can be read."""
    maps = [out / name for name in ("mosaic.png", "mosaic.tif", "nav2.pgm")]
    return any(path.exists() and cv2.imread(str(path)) is not None for path in maps)


def main() -> int:
    """Run the cases that have no row yet, and print the table; exit 1 when anything failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--match", default="", help="only cases whose name has this text")
    parser.add_argument("--part", default="0/1", help="I/N: every N-th case from the I-th on")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    os.chdir(given.folder)
    for module, _ in WORK:
        import_module(module)
    cv2.setNumThreads(1)
    set_up()
    part, parts = map(int, given.part.split("/"))
    every = [case for case in (*option_cases(), *field_cases()) if given.match in case.name]
    cases = every[part::parts]
    table = Path("boundaries.csv")
    rows = list(csv.reader(table.open())) if table.exists() else []
    with table.open("a", newline="") as stream:
        writer = csv.writer(stream)
        for case in cases[len(rows) :]:
            row = list(map(str, outcome_of(case)))
            writer.writerow(row)
            stream.flush()
            rows.append(row)
            if row[1] in _FAULTS:
                print(*row, flush=True)
    found = Counter(("option" if "=" in row[0] else "field", row[1]) for row in rows)
    print("| value | tried | " + " | ".join(OUTCOMES) + " |")
    print("|---" * (len(OUTCOMES) + 2) + "|")
    for kind in ("option", "field"):
        counts = [found[kind, outcome] for outcome in OUTCOMES]
        print("| " + " | ".join(map(str, [kind, sum(counts), *counts])) + " |")
    slowest = max(rows, key=lambda row: float(row[2]))
    largest = max(rows, key=lambda row: float(row[3]))
    print(f"longest {slowest[2]} s ({slowest[0]}); most memory {largest[3]} MB ({largest[0]})")
    return int(any(row[1] in _FAULTS for row in rows))


if __name__ == "__main__":
    sys.exit(main())
