"""`slam view`: what its server gives, and to whom."""

from __future__ import annotations

import http.client
import json
import sys
import threading
import types
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam

from slamcli.io import rerun_recording
from slamcli.io.loopback import LoopbackServer
from slamcli.io.map_file import load_map
from slamcli.run.report import REPORT_NAME
from slamcli.run.view import open_server


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LoopbackServer]:
    folder = tmp_path / "out"
    (folder / "mosaic_files" / "3").mkdir(parents=True)
    (folder / "mosaic_files" / "3" / "0_0.png").write_bytes(b"a tile")
    (folder / REPORT_NAME).write_text("<p>the report</p>", encoding="utf-8")
    (folder / "poses.csv").write_text("secret", encoding="utf-8")
    made = open_server(folder)
    thread = threading.Thread(target=made.serve)
    thread.start()
    yield made
    made.close()
    thread.join()


def get(server: LoopbackServer, path: str, host: str | None = None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(*server.address[7:-1].split(":"), timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_it_gives_the_report_and_tiles_and_nothing_else(server: LoopbackServer) -> None:
    assert server.address.startswith("http://127.0.0.1:")
    status, page = get(server, "/")
    assert status == 200
    assert b"the report" in page
    assert get(server, "/mosaic_files/3/0_0.png") == (200, b"a tile")
    assert get(server, "/mosaic_files/3/7_7.png")[1].startswith(b"\x89PNG")
    for path in ("/poses.csv", "/mosaic_files/../poses.csv", "//etc/passwd", "/mosaic_files/3/"):
        assert get(server, path)[0] == 404, path


def test_it_is_no_use_to_pages_of_elsewhere(server: LoopbackServer) -> None:
    """A name of somebody else's that leads to this machine (DNS rebinding) gets nothing."""
    assert get(server, "/", "evil.example:80")[0] == 404
    assert get(server, "/", "localhost:80")[0] == 200


def test_what_cannot_be_shown_is_one_line(server: LoopbackServer, tmp_path: Path) -> None:
    result = slam("view", tmp_path)
    assert result.exit_code == 1
    assert "give the output folder of slam stitch" in result.output
    port = server.address.rpartition(":")[2].strip("/")
    result = slam("view", tmp_path / "out", "--port", port, "--no-browser")
    assert result.exit_code == 1
    assert "give another --port" in result.output


def test_a_recording_for_rerun_has_the_map_and_the_frames(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[tuple[str, dict[str, object]]] = []
    module = stand_in_for_rerun(logged)
    monkeypatch.setitem(sys.modules, "rerun", module)
    monkeypatch.setattr(rerun_recording, "find_spec", lambda _: module)
    assert slam("stitch", drive, "-o", tmp_path / "out").exit_code == 0
    result = slam("view", tmp_path / "out", "--rerun", tmp_path / "out.rrd", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["recording"] == str(tmp_path / "out.rrd")
    assert (tmp_path / "out.rrd").read_bytes() == b"recorded"
    names = [name for name, _ in logged]
    assert names.count("camera") == 5
    # The floor's corners: the mosaic spans the path, and floor ahead of it.
    floor = next(values["vertex_positions"] for name, values in logged if name == "map/mosaic")
    assert np.ptp(np.asarray(floor), axis=0) == pytest.approx(mosaic_metres(tmp_path / "out"))
    places = [v["translation"] for name, v in logged if name == "map/robot" and "translation" in v]
    truth = [estimate.map_from_robot for estimate in load_map(tmp_path / "out").estimates]
    assert np.asarray(places)[:, :2] == pytest.approx(
        np.array([(pose.x, pose.y) for pose in truth if pose is not None])
    )
    again = slam("view", tmp_path / "out", "--rerun", tmp_path / "out.rrd")
    assert again.exit_code == 1
    assert "--overwrite" in again.output
    for path in (tmp_path / "out" / "mosaic.png", next(drive.glob("*.jpg"))):
        before = path.read_bytes()
        refused = slam("view", tmp_path / "out", "--rerun", path, "--overwrite")
        assert "is an input of this command" in refused.output
        assert path.read_bytes() == before


def test_without_rerun_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_recording, "find_spec", lambda _: None)
    result = slam("view", tmp_path, "--rerun", tmp_path / "out.rrd")
    assert result.exit_code == 1
    assert "pip install 'slamcli[rerun]'" in result.output


def mosaic_metres(run: Path) -> tuple[float, float, float]:
    height, width = cv2.imread(str(run / "mosaic.png")).shape[:2]
    scale = float((run / "mosaic.pgw").read_text().split()[0])
    return width * scale, height * scale, 0.0


def stand_in_for_rerun(logged: list[tuple[str, dict[str, object]]]) -> types.ModuleType:
    """Return a module with the part of rerun's interface that is used; rerun is 700 MB."""

    class Recording:
        def __init__(self, name: str, recording_id: str) -> None:
            pass

        def memory_recording(self) -> Recording:
            return self

        def drain_as_bytes(self) -> bytes:
            return b"recorded"

        def log(self, name: str, what: object, *, static: bool = False) -> None:
            logged.append((name, what if isinstance(what, dict) else {}))

        def __getattr__(self, name: str) -> object:
            return lambda *_, **__: None

    module = types.ModuleType("rerun")
    kinds = ("Mesh3D", "LineStrips3D", "Arrows3D", "EncodedImage", "TextLog", "Transform3D")
    for kind in (*kinds, "Quaternion", "Scalars"):
        setattr(module, kind, lambda *given, **named: {"given": given, **named})
    module.__dict__["RecordingStream"] = Recording
    module.__dict__["ViewCoordinates"] = types.SimpleNamespace(RIGHT_HAND_Z_UP=None)
    return module
