"""A camera's stream for tests: pictures on loopback as motion JPEG, each until it was placed."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np

_SECONDS = 60.0


def free_port() -> int:
    """Return a port of this machine that nothing listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def get(port: int, path: str) -> bytes:
    """Return what a server of this machine answers; nothing where it does not."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.read() if answer.status == 200 else b""
    except OSError:
        return b""
    finally:
        connection.close()


def state_of(port: int) -> dict[str, Any]:
    """Return what the page of `slam live` knows; nothing before it is there."""
    found: dict[str, Any] = json.loads(get(port, "/state.json") or b"{}")
    return found


@contextmanager
def stream(
    pictures: Sequence[np.ndarray], page_port: int, at_end: Callable[[], object] = lambda: None
) -> Iterator[str]:
    """Yield the address of a stream that shows each picture until the page has counted it.

    At the end a function is called, and the stream closed.
    """
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98]
    encoded = [cv2.imencode(".jpg", picture, quality)[1].tobytes() for picture in pictures]

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            end = time.monotonic() + _SECONDS
            for number, data in enumerate(encoded):
                head = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
                while state_of(page_port).get("frames", 0) <= number and time.monotonic() < end:
                    try:
                        self.wfile.write(head % len(data) + data + b"\r\n")
                    except OSError:  # refused: the reader is gone
                        return
                    time.sleep(0.02)
            at_end()
            self.close_connection = True

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/video.mjpg"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
