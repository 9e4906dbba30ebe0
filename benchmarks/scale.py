"""Scaling of time and memory with the length of a run.

Run: python benchmarks/scale.py DRIVE [--frames N] [--metres-per-pixel M] [--json FILE]. DRIVE is
what `slam simulate` has written; its frames are linked forwards, then backwards, and so on, until
there are N. Printed for every tenth of the frames: wall and processor time a frame, and
the most memory that the process has taken by then.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

from slamcli.core.config import MapperOptions, PaintOptions, ProductOptions
from slamcli.run.session.executor import default_workers
from slamcli.run.session.session import Session
from slamcli.run.stitch import stitch
from slamcli.run.stitch.options import StitchOptions

PARTS = 10


@dataclass(frozen=True)
class Mark:
    """Progress of a run, with the time and memory used until then."""

    stage: str
    done: int
    wall_seconds: float
    processor_seconds: float
    peak_megabytes: float


def mark(stage: str, done: int) -> Mark:
    """Return the current mark."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return Mark(stage, done, time.perf_counter(), time.process_time(), peak)


def repeat(drive: Path, count: int, folder: Path) -> None:
    """Link a drive's frames into a folder, forwards and backwards in turn."""
    frames = sorted((drive / "frames").iterdir())
    for number in range(count):
        turn, place = divmod(number, len(frames))
        source = frames[place if turn % 2 == 0 else -1 - place]
        (folder / f"{number:06d}{source.suffix}").symlink_to(source.resolve())


def measure(drive: Path, count: int, metres_per_pixel: float | None, work: Path) -> list[Mark]:
    """Map the frames; return a mark for the start and for the end of every part."""
    frames = work / "frames"
    frames.mkdir()
    repeat(drive, count, frames)
    part, marks = max(1, count // PARTS), [mark("start", 0)]

    def progress(stage: str, done: int, total: int) -> None:
        if done == total or (stage == "locating" and done % part == 0):
            marks.append(mark(stage, done))

    options = StitchOptions(
        MapperOptions(),
        products=ProductOptions(PaintOptions(metres_per_pixel=metres_per_pixel)),
    )
    session = Session(default_workers(), progress=progress, notify=print)
    camera, output = drive / "camera.yaml", work / "map"
    report = stitch([frames], camera, output, options, overwrite=True, session=session)
    print(report)
    return [*marks, mark("end", count)]


def table(marks: list[Mark]) -> str:
    """Return the cost of each part, as a table in Markdown."""
    lines = ["| stage | frames | wall ms a frame | CPU ms a frame | peak MB |", "|" + "---|" * 5]
    for before, after in pairwise(marks):
        count = after.done - before.done if after.stage == "locating" else after.done
        wall = 1e3 * (after.wall_seconds - before.wall_seconds) / count
        processor = 1e3 * (after.processor_seconds - before.processor_seconds) / count
        lines.append(
            f"| {after.stage} | to {after.done} | {wall:.1f} | {processor:.1f} | "
            f"{after.peak_megabytes:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--metres-per-pixel", type=float)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        marks = measure(arguments.drive, arguments.frames, arguments.metres_per_pixel, Path(folder))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors")
    print(table(marks))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(one) for one in marks], indent=1))


if __name__ == "__main__":
    main()
