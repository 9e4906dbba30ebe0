"""A net under a redesign: every file that the commands write, before a change and after it.

    python benchmarks/compare_outputs.py record before/     # in the old checkout
    python benchmarks/compare_outputs.py record after/      # in the new one, same packages
    python benchmarks/compare_outputs.py compare before/ after/

Names of commands after the folder record these alone (and `calibrate`, which the others need).

`record` runs the commands below on the samples, with the package that this Python has installed,
and keeps what they write and print. `compare` names every file that differs by a byte, among what
both recorded; it exits 1 when there is one. Run times are left out. Some three minutes for all.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

SAMPLES = Path(__file__).resolve().parent.parent / "samples"
# Name, and the arguments of `slam`; paths are relative to the folder that is recorded into.
COMMANDS = [
    ("calibrate", "calibrate square.png --side 0.3048 -o calibration.yaml"),
    (
        "stitch_1",
        "stitch frames -c calibration.yaml -o stitch_1 --workers 1 --frame-rate 10 "
        "--export tum,g2o,links",
    ),
    ("stitch_2", "stitch frames -c calibration.yaml -o stitch_2 --workers 2 --frame-rate 10"),
    (
        "sensors",
        "stitch frames -c calibration.yaml -o sensors --odometry odometry.csv "
        "--compass compass.csv --gps gps.csv --frame-rate 10 --export geojson "
        "--layers views,resolution,last-frame --no-{obstacles} --format png,nav2,deepzoom",
    ),
    ("self_calibrated", "stitch frames -c calibration.yaml -o self_calibrated --self-calibrate"),
    ("uncalibrated", "stitch frames -o uncalibrated --debug"),
    ("plain", "stitch frames -c calibration.yaml -o plain --no-dense --no-loops --features sift"),
    ("late", "stitch late -c calibration.yaml -o late_map"),
    ("extended", "stitch frames --extend late_map -o extended"),
    ("render", "render stitch_1 -o rendered --blend feather --format png,geotiff"),
    ("locate", "locate stitch_1 frames -o located.csv --json"),
    ("evaluate", "evaluate stitch_1/poses.csv truth.csv --json"),
    ("warp", "warp frames -c calibration.yaml -o warped"),
    ("detect", "detect frames -c calibration.yaml -o features"),
    (
        "simulate",
        "simulate drive --floor tiles --frames 6 --size 320x240 --boxes 2 --seed 4 --no-light",
    ),
    ("match_facade", "match appendix_a/facade_turned.jpg appendix_a/facade.jpg --json"),
    ("match_portrait", "match appendix_a/portrait_turned.jpg appendix_a/portrait.jpg --json"),
    ("match_field", "match appendix_a/figure.jpg appendix_a/field.jpg --json -o match.png"),
    ("match_unlike", "match appendix_a/figure.jpg appendix_a/portrait.jpg --json"),
]


def record(folder: Path, only: Collection[str] = ()) -> None:
    """Run every command in a new folder, and keep what it prints and its exit code."""
    folder.mkdir(parents=True)
    for path in (*(SAMPLES / "course").iterdir(), SAMPLES / "appendix_a"):
        if path.is_dir():
            shutil.copytree(path, folder / path.name)
        else:
            shutil.copy(path, folder)
    (folder / "late").mkdir()
    for frame in sorted((folder / "frames").iterdir())[:24]:
        shutil.copy(frame, folder / "late")
    told = subprocess.run(
        [sys.executable, "-m", "slamcli", "stitch", "--help"], capture_output=True, text=True
    ).stdout
    obstacles = "obstacles" if "--obstacles" in told else "standing"
    for name, arguments in COMMANDS:
        if only and name not in {"calibrate", *only}:
            continue
        words = arguments.format(obstacles=obstacles).split()
        done = subprocess.run(
            [sys.executable, "-m", "slamcli", *words],
            cwd=folder,
            capture_output=True,
            text=True,
            env={**os.environ, "COLUMNS": "80"},
        )
        (folder / f"{name}.txt").write_text(f"{done.stdout}exit {done.returncode}\n")
        print(f"{name}: exit {done.returncode} {done.stderr[-300:] if done.returncode else ''}")


def content(path: Path, folder: Path) -> bytes:
    """Return a file's bytes, without how long a run took and where it was."""
    data = path.read_bytes()
    if path.suffix in {".txt", ".toml"}:
        data = re.sub(rb"\d+\.\d+ s\b(, \d+\.\d+ frames/s)?", b"some s", data)
        data = data.replace(str(folder.resolve()).encode(), b"here")
    elif path.suffix == ".slam":
        # After the first line: a checksum, the header's length, and in the header the frames' path.
        first, rest = data.split(b"\n", 1)
        data = first + rest[40:].replace(str(folder.resolve()).encode(), b"here")
    return data


def compare(before: Path, after: Path) -> int:
    """Print every file that is not the same in both folders; return the exit code."""
    names = {
        str(path.relative_to(folder))
        for folder in (before, after)
        for path in folder.rglob("*")
        if path.is_file() and path.name != "timing.toml"
    }
    recorded = [{path.stem for path in folder.glob("*.txt")} for folder in (before, after)]
    missing = {command for command, _ in COMMANDS} - (recorded[0] & recorded[1])
    folders = {
        words.split()[words.split().index("-o") + 1]: command
        for command, words in COMMANDS
        if "-o" in words.split()
    } | {"drive": "simulate"}
    differing = 0
    for name in sorted(names):
        top = name.split("/")[0]
        if folders.get(top, top.removesuffix(".txt")) in missing:
            continue
        there = [folder / name for folder in (before, after)]
        if not all(path.exists() for path in there):
            print(f"only in {before if there[0].exists() else after}: {name}")
        elif content(there[0], before) != content(there[1], after):
            print(f"differs: {name}")
        else:
            continue
        differing += 1
    print(f"{len(names) - differing} of {len(names)} files are the same byte for byte")
    return 1 if differing else 0


if __name__ == "__main__":
    if len(sys.argv) >= 3 and sys.argv[1] == "record":
        record(Path(sys.argv[2]).resolve(), sys.argv[3:])
    elif len(sys.argv) == 4 and sys.argv[1] == "compare":
        sys.exit(compare(Path(sys.argv[2]), Path(sys.argv[3])))
    else:
        sys.exit(__doc__)
