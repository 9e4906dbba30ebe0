"""A Dask cluster of separate processes does what threads do, even when one of them dies."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from command_line import contents, slam

from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.run.session.cluster import Cluster
from slamcli.run.session.session import Session
from slamcli.run.stitch import stitch
from slamcli.run.stitch.options import StitchOptions

distributed = pytest.importorskip("distributed")

FRAMES = 6


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "drive"
    arguments = ["--frames", str(FRAMES), "--size", "320x240", "--length", "0.5", "--no-light"]
    done = slam("simulate", folder, *arguments)
    assert done.exit_code == 0, done.output
    return folder


class _Scripted:
    """A Dask client and executor: the first result's worker is dead by the time it arrives."""

    status = "running"

    def __init__(self) -> None:
        self.submitted = 0

    def get_executor(self, **_: Any) -> _Scripted:
        return self

    def submit(self, _: Any, *__: Any, **___: Any) -> Future[str]:
        self.submitted += 1
        future: Future[str] = Future()
        # The function itself is the first that is submitted.
        statuses = {2: "lost"}
        arrived = _Arrived(statuses.get(self.submitted, "finished"))
        asyncio.run(self.cascade(arrived, future))
        return future

    @staticmethod
    async def cascade(arrived: _Arrived, future: Future[str]) -> None:
        await distributed.cfexecutor._cascade_future(arrived, future)

    def sync(self, *_: Any, **__: Any) -> dict[str, list[str]]:
        return {"workers": ["one"]}

    @property
    def scheduler(self) -> _Scripted:
        return self

    identity = None


class _Arrived:
    def __init__(self, status: str) -> None:
        self.status = status

    async def _result(self, *, raiseit: bool) -> str:
        assert not raiseit
        return "a frame"


def test_a_result_whose_worker_dies_as_it_arrives_is_computed_anew() -> None:
    client = _Scripted()
    cluster = Cluster(client, "tcp://nowhere:1")
    assert cluster.result(cluster.submit(str)) == "a frame"
    assert client.submitted == 3


@pytest.mark.slow
def test_a_worker_that_dies_changes_no_byte(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(output: Path, scheduler: str, victim: int | None) -> None:
        def progress(stage: str, done: int, total: int) -> None:
            if victim is not None and (stage, done) == ("locating", 2):
                os.kill(victim, signal.SIGKILL)

        options = StitchOptions(MapperOptions())
        # A worker stands elsewhere: relative paths must reach it.
        monkeypatch.chdir(drive)
        report = stitch(
            [type(drive)("frames")],
            type(drive)("camera.yaml"),
            output,
            options,
            overwrite=False,
            session=Session(2, scheduler, progress),
        )
        assert report is not None

    run(tmp_path / "threads", "", None)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        processes = list(client.run(os.getpid).values())
        assert len(set(processes)) == 2
        assert os.getpid() not in processes
        run(tmp_path / "cluster", cluster.scheduler_address, processes[0])
        with pytest.raises(ProcessLookupError):
            os.kill(processes[0], 0)
    for name in ("mosaic.png", "poses.csv", "map.slam"):
        expected = (tmp_path / "threads" / name).read_bytes()
        assert (tmp_path / "cluster" / name).read_bytes() == expected, name


def test_where_no_scheduler_answers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slamcli.run.session.cluster._CONNECT_SECONDS", 0.2)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(Session(1, "tcp://127.0.0.1:9").ordered(abs, [1, 2]))


class Machines:
    """A scheduler and a worker as processes of their own, and how the tests end them."""

    def __init__(self, folder: Path, *, worker: bool) -> None:
        self._file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--scheduler-file", str(self._file))
        deadline = time.monotonic() + 30
        while not self._file.exists() or not self._file.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        self.address: str = json.loads(self._file.read_text())["address"]
        self.worker = None
        if worker:
            self.worker = self._start("worker", self.address, "--nthreads", "1", "--no-nanny")

    @staticmethod
    def _start(kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
        words += ["--host", "127.0.0.1", "--no-dashboard"]
        if kind == "scheduler":
            words += ["--port", "0"]
        return subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def fail(self, how: str) -> None:
        """Let the machines fail in one of the ways."""
        if how == "workers dead":
            assert self.worker is not None
            self.worker.kill()
        elif how == "scheduler dead":
            self.scheduler.kill()
        elif how == "scheduler hangs":
            self.scheduler.send_signal(signal.SIGSTOP)

    def end(self) -> None:
        """End the processes."""
        for process in filter(None, (self.scheduler, self.worker)):
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("no workers", "has no workers; start one with `dask worker tcp://"),
        ("workers dead", "has no workers; start one with `dask worker tcp://"),
        ("scheduler dead", "does not answer any more"),
        ("scheduler hangs", "does not answer any more"),
    ],
)
@pytest.mark.parametrize("stage", ["locating", "painting"])
def test_a_cluster_that_fails_is_one_line_and_the_run_goes_on_without_it(
    samples_folder: Path, tmp_path: Path, how: str, reason: str, stage: str
) -> None:
    if (how, stage) == ("no workers", "painting"):
        pytest.skip("nothing is painted without workers")
    drive = tmp_path / "drive"
    drive.mkdir()
    for index in range(FRAMES):
        shutil.copy(samples_folder / "course" / "frames" / f"{index:04d}.jpg", drive)
    shutil.copy(samples_folder / "course" / "camera.yaml", drive / "calibration.yaml")
    machines = Machines(tmp_path, worker=how != "no workers")
    output, command = tmp_path / "out", [sys.executable, "-m", "slamcli", "stitch"]
    command += [str(drive), "-o", str(output), "--scheduler", machines.address]
    command += ["--metres-per-pixel", "0.001"]
    try:
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            started = time.monotonic()
            if how != "no workers":
                next(line for line in process.stderr if line.startswith(stage))
                started = time.monotonic()
                machines.fail(how)
            said = process.stderr.read()
        assert time.monotonic() - started < 30
        assert process.returncode == 1
        lines = [line for line in said.splitlines() if not re.match(r"[a-z ]+ \d+/\d+", line)]
        assert reason in lines[-1], said
        assert "Traceback" not in said
    finally:
        machines.end()
    assert not list(output.glob(".partial-*"))
    whole = tmp_path / "whole"
    for folder, more in ((output, ["--resume"]), (whole, [])):
        done = slam("stitch", drive, "-o", folder, "--metres-per-pixel", "0.001", *more)
        assert done.exit_code == 0, done.output
        if more and how != "no workers":
            assert "frames had been located" in done.output
    assert contents(output) == contents(whole)
