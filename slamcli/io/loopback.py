"""A web server for the browser of this machine alone: pages and pictures made by a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from slamcli.core.errors import InputError

_HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Answer:
    """What is sent for a path: the MIME type and the bytes."""

    kind: str
    body: bytes


class LoopbackServer:
    """Answers GET requests of this machine's browser until it is interrupted.

    Parameters
    ----------
    answer : callable
        From a path, with its leading slash and without a query, to its answer; None for none.
        Called by several threads.
    port : int
        0 takes a free one.

    Raises
    ------
    InputError
        When the port is taken.
    """

    def __init__(self, answer: Callable[[str], Answer | None], port: int = 0) -> None:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                found = answer(self.path.partition("?")[0]) if self._is_local() else None
                if found is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", found.kind)
                self.send_header("Content-Length", str(len(found.body)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(found.body)

            def _is_local(self) -> bool:
                # A page of elsewhere may have a name of its own lead to this machine.
                name = self.headers.get("Host", "").rpartition(":")[0]
                return name in {_HOST, "localhost"}

            def log_message(self, *_: Any) -> None:
                pass

        try:
            self._server = ThreadingHTTPServer((_HOST, port), Handler)
        except OSError as error:
            raise InputError(
                f"cannot listen on port {port}: {error.strerror or error}; give another --port"
            ) from error
        self._server.daemon_threads = True

    @property
    def address(self) -> str:
        """The URL of its first page."""
        return f"http://{_HOST}:{self._server.server_address[1]}/"

    def serve(self) -> None:
        """Answer until `close` is called by another thread, or the program is interrupted."""
        try:
            self._server.serve_forever()
        finally:
            self._server.server_close()

    def close(self) -> None:
        """End `serve`."""
        self._server.shutdown()
