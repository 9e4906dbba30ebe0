"""`slam view`: what its server gives, and to whom."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import slam

from slamcli.io.loopback import LoopbackServer
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
