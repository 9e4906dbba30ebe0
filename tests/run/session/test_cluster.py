"""A Dask cluster of separate processes does what threads do, even when one of them dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from command_line import slam

from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
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
