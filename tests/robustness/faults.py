"""Faults of the machine: a stitch killed, interrupted, on a full disk, or whose frames vanish.

Each case cuts a run off at some moment, resumes it, and compares all files with those of a run
that was left alone. One row is written for each; a list that is cut off goes on after its last row.

    python tests/robustness/faults.py FOLDER [--kills 60] [--disks 20] [--size 640x480] [--survey]
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[2]
COURSE = ROOT / "samples" / "course"
# Twice Ctrl-C ends a run at once.
ENDINGS = (
    (signal.SIGKILL,),
    (signal.SIGTERM,),
    (signal.SIGKILL,),
    (signal.SIGHUP,),
    (signal.SIGINT, signal.SIGINT),
)
# Three times as large, without 180 rows above and below.
_LARGE = {
    "640": "1920",
    "480": "1080",
    "532.5694343521658": "1597.7083030564974",
    "319.5": "959.5",
    "239.5": "539.5",
}
_PROGRESS = re.compile(r"[a-z ]+ \d+/\d+, .*")
_CODES = {0, 1, 3, 130}
_MOUNT_TRIES = 100


@dataclass(frozen=True)
class Outcome:
    """What came of a fault, one row of the table.

    Attributes
    ----------
    kind, moment : str
    stage : str
        The last line of progress before the fault.
    code : int
        Exit code of the run that was cut off.
    clean : bool
        No traceback, and nothing half-written is left (but by SIGKILL, before the next run).
    resumed : str
        What `--resume` said of the state.
    same : bool
        All files have the bytes of a run that was left alone, and there is no other file.
    """

    kind: str
    moment: str
    stage: str
    code: int
    clean: bool
    resumed: str
    same: bool


class Drive:
    """A small drive, the command that stitches it, and the bytes that must come of it."""

    def __init__(self, folder: Path, size: str, count: int, *, survey: bool = False) -> None:
        self.folder = folder
        # Frames without a calibration are those of a survey.
        self.survey = survey
        self.frames = folder / "frames"
        if not self.frames.is_dir():
            self._make(size, count)
        whole = folder / "whole"
        self.gaps_seconds = self._time(whole)
        self.expected = contents(whole)

    def _time(self, output: Path) -> list[float]:
        """Run to the end; return the seconds before each line of progress, and after the last."""
        times, said = [time.monotonic()], ""
        with subprocess.Popen(
            self.command(output, "--overwrite"),
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env=_environment(),
        ) as process:
            assert process.stderr is not None
            for line in process.stderr:
                said += line
                if _PROGRESS.fullmatch(line.strip()):
                    times.append(time.monotonic())
        assert process.returncode == 0, said
        times.append(time.monotonic())
        return [after - before for before, after in pairwise(times)]

    def _make(self, size: str, count: int) -> None:
        making = self.folder / "making"
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir(parents=True)
        frames = [COURSE / "frames" / f"{index:04d}.jpg" for index in range(count)]
        camera = (COURSE / "camera.yaml").read_text()
        if size == "640x480":
            for path in frames:
                shutil.copy(path, making)
        else:
            for path in frames:
                large = cv2.resize(cv2.imread(str(path)), (1920, 1440))
                cv2.imwrite(str(making / path.name), large[180:-180])
            camera = re.sub(r" +# Undistorted.*", "", camera, flags=re.DOTALL)
            for old, new in _LARGE.items():
                camera = camera.replace(old, new)
        if not self.survey:
            (making / "calibration.yaml").write_text(camera)
        making.rename(self.frames)

    def command(self, output: Path, *more: str) -> list[str]:
        """Return the words of a stitch."""
        return [*_SLAM, "stitch", str(self.frames), "-o", str(output), *more]

    def run(self, output: Path, *more: str) -> tuple[int, str]:
        """Run a stitch to its end; return its exit code and what it printed."""
        words = self.command(output, *more)
        done = subprocess.run(
            words, capture_output=True, text=True, env=_environment(), check=False
        )
        return done.returncode, done.stdout + done.stderr

    def gone_on_with(self, output: Path, kind: str, moment: str, cut: tuple[int, str]) -> Outcome:
        """Resume a run that was cut off, and return what came of it."""
        code, said = cut
        stages = [line for line in said.splitlines() if _PROGRESS.fullmatch(line)]
        killed = code == -signal.SIGKILL
        # From a disk that is read-only nothing is deleted.
        kept = killed or kind == "read-only"
        left = [] if kept else [*output.glob(".partial-*"), *output.glob(".lock")]
        # Before the program has begun, a signal ends Python itself.
        begun = bool(stages)
        clean = "Traceback" not in said and not left and (not begun or killed or code in _CODES)
        resumed = "was complete"
        if code != 0:
            last, said = self.run(output, "--resume")
            notices = re.findall(r"resumed: .*|nothing to resume|already has", said)
            resumed = notices[0] if notices else said.splitlines()[-1]
            clean &= "Traceback" not in said
            clean &= last == 0 or "already has" in said
        same = contents(output) == self.expected
        stage = stages[-1] if stages else ""
        return Outcome(kind, moment, stage, code, clean, resumed, same)


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder, hidden ones too, but how long the run took."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != "timing.toml")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def kill(drive: Drive, output: Path, line: float, ending: tuple[signal.Signals, ...]) -> Outcome:
    """End a run by signals after a number of lines of progress.

    A fraction is that of the time to the next line.
    """

    def end(process: subprocess.Popen[str]) -> None:
        time.sleep(line % 1 * drive.gaps_seconds[int(line)])
        for number in ending:
            process.send_signal(number)
            time.sleep(0.05)

    cut = at_line(drive, output, int(line), end)
    names = "+".join(number.name for number in ending)
    return drive.gone_on_with(output, names, f"line {line:.2f}", cut)


@contextlib.contextmanager
def disk(folder: Path, size: int) -> Iterator[Callable[[str], None]]:
    """Mount a disk of some bytes; yield a function that mounts it anew with other options."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)

    def again(options: str) -> None:
        words = {
            # Over itself, as a disk with files that are open is not made read-only.
            "ro": [["mount", "--bind", folder, folder]],
            "rw": [["umount", folder]],
        }.get(options, [])
        if options != "rw":
            bound = "remount,bind,ro" if options == "ro" else f"remount,{options}"
            words.append(["mount", "-o", bound, folder])
        for one in words:
            # While a file is being written, a disk is busy.
            for _ in range(_MOUNT_TRIES):
                if subprocess.run(one, check=False).returncode == 0:
                    break
                time.sleep(0.02)
            else:
                raise OSError(f"cannot mount: {one}")

    try:
        yield again
    finally:
        subprocess.run(["umount", folder], check=True)


def full_disk(drive: Drive, output: Path, size: int) -> Outcome:
    """Run on a disk that becomes full; resume when there is room."""
    with disk(output.parent / "disk", size) as again:
        there = output.parent / "disk" / "out"
        cut = drive.run(there)
        again("size=1g")
        return drive.gone_on_with(there, "full disk", f"{size >> 10} KiB", cut)


def full_file(drive: Drive, output: Path, size: int) -> Outcome:
    """Run where no file may have more bytes than these; resume without that limit."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    done = subprocess.run(
        drive.command(output),
        capture_output=True,
        text=True,
        env=_environment(),
        preexec_fn=limit,
        check=False,
    )
    cut = done.returncode, done.stdout + done.stderr
    return drive.gone_on_with(output, "file limit", f"{size >> 10} KiB", cut)


def at_line(
    drive: Drive,
    output: Path,
    start: str | int,
    fault: Callable[[subprocess.Popen[str]], object],
) -> tuple[int, str]:
    """Run a stitch, with a fault after the first line that starts so, or after so many lines."""
    said, lines = "", 0
    with subprocess.Popen(
        drive.command(output),
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=_environment(),
    ) as process:
        assert process.stderr is not None
        line = ""
        while lines < start if isinstance(start, int) else not line.startswith(start):
            line = process.stderr.readline()
            if not line:
                break
            said, lines = said + line, lines + (_PROGRESS.fullmatch(line.strip()) is not None)
        fault(process)
        out, rest = process.communicate()
    return process.returncode, said + rest + out


def read_only(drive: Drive, output: Path, start: str) -> Outcome:
    """Make the disk read-only at some line; resume when it is not."""
    with disk(output.parent / "disk", 1 << 30) as again:
        there = output.parent / "disk" / "out"
        cut = at_line(drive, there, start, lambda _: again("ro"))
        again("rw")
        return drive.gone_on_with(there, "read-only", start, cut)


def vanished(drive: Drive, output: Path, start: str) -> Outcome:
    """Take the frames away at some line; resume when they are back."""
    away = drive.folder / "away"
    cut = at_line(drive, output, start, lambda _: drive.frames.rename(away))
    if away.exists():
        away.rename(drive.frames)
    return drive.gone_on_with(output, "frames vanish", start, cut)


def two_runs(drive: Drive, output: Path, start: str) -> Outcome:
    """Start a second run into the folder of one that is at work."""
    second: list[tuple[int, str]] = []

    def run_again(first: subprocess.Popen[str]) -> None:
        # So that the first is still at work when the second begins.
        first.send_signal(signal.SIGSTOP)
        second.append(drive.run(output, "--overwrite"))
        first.send_signal(signal.SIGCONT)

    code, _ = at_line(drive, output, start, run_again)
    (refused, said), line = second[0], second[0][1].splitlines()[-1]
    clean = (code, refused) == (0, 1) and line.startswith("Error: another run (process")
    clean &= "Traceback" not in said
    same = contents(output) == drive.expected
    return Outcome("two runs", start, start, code, clean, line, same)


def _environment() -> dict[str, str]:
    one = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    return {**os.environ, "PYTHONPATH": str(ROOT), **one}


_SLAM = [sys.executable, "-m", "slamcli"]


def cases(drive: Drive, kills: int, disks: int, output: Path) -> Iterator[Callable[[], Outcome]]:
    """Yield all cases, in their order."""
    for number in range(kills):
        # From the start to the end, after the last line, when the results are written.
        line, ending = len(drive.gaps_seconds) * number / kills, ENDINGS[number % len(ENDINGS)]
        yield lambda line=line, ending=ending: kill(drive, output, line, ending)
    total = sum(map(len, drive.expected.values()))
    for number in range(disks):
        # From what the first states take to more than all that is written at a time.
        size = int(total * (0.5 + 2.0 * number / disks))
        yield lambda size=size: full_disk(drive, output, size)
    for start in ("locating", "painting") if disks else ():
        yield lambda start=start: read_only(drive, output, start)
    for start in ("locating", "comparing", "painting"):
        yield lambda start=start: vanished(drive, output, start)
        yield lambda start=start: two_runs(drive, output, start)


def main() -> None:
    """Run the cases that have no row yet, and print all rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--disks", type=int, default=20)
    parser.add_argument("--size", choices=("640x480", "1920x1080"), default="640x480")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--survey", action="store_true", help="frames without a calibration")
    given = parser.parse_args()
    # A shell lets what runs in the background ignore them, and so would the runs.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    drive = Drive(given.folder.resolve(), given.size, given.frames, survey=given.survey)
    table = drive.folder / "faults.csv"
    output = drive.folder / "cut"
    done = len(table.read_text().splitlines()) - 1 if table.exists() else 0
    with table.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, [field.name for field in fields(Outcome)])
        if done <= 0:
            writer.writeheader()
        for number, case in enumerate(cases(drive, given.kills, given.disks, output)):
            if number >= done:
                shutil.rmtree(output, ignore_errors=True)
                outcome = asdict(case())
                writer.writerow(outcome)
                stream.flush()
                sys.stdout.write(f"{outcome}\n")
    rows = list(csv.DictReader(table.open()))
    good = sum(row["clean"] == row["same"] == "True" for row in rows)
    sys.stdout.write(f"{good} of {len(rows)} clean, and with the same bytes\n")
    sys.exit(0 if good == len(rows) else 1)


if __name__ == "__main__":
    main()
