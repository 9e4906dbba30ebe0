"""report.html in a real browser: drawn, clicked, without an error or a request."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Page, browser

from slamcli.io.raster.deepzoom import write_deep_zoom, write_position
from slamcli.run.report import REPORT_NAME, write_report
from slamcli.run.report.run import FinishedRun
from slamcli.run.session.session import Session
from slamcli.run.view import open_server

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")

# The mean colour of a part of the map's canvas, and where a frame of it lies in the window.
COLOUR = """(() => {{ const c = document.getElementById('floor'), at = [{x}, {y}];
  return [...c.getContext('2d').getImageData(at[0], at[1], 1, 1).data].slice(0, 3); }})()"""
CARD = "document.getElementById('card').innerText"


@pytest.fixture
def page(run: FinishedRun, tmp_path: Path) -> Iterator[Page]:
    write_report(tmp_path, run, Session())
    with browser(tmp_path / "profile") as found:
        found.open((tmp_path / REPORT_NAME).as_uri())
        found.wait("document.body.dataset.drawn === 'yes'")
        found.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        yield found


def test_the_map_is_drawn_and_answers(page: Page, tmp_path: Path) -> None:
    left, top, width, height = page.run(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.getElementById('floor').getBoundingClientRect())"
    )
    # Floor of the map's picture, brightened a little; its blue, green and red are 40, 90 and 140.
    red, green, blue = page.run(COLOUR.format(x=int(0.3 * width), y=int(0.3 * height)))
    assert red > green + 20 > blue + 40
    # The first frame is shown from the start; a click on another one shows that.
    assert "0000.jpg" in page.run(CARD)
    page.run("document.querySelector('[data-colour=sigma]').click()")
    assert "sigma of the position" in page.run("document.getElementById('legend').innerText")
    # Frame 5, at 5, 2.5: the picture spans x from -1 to 7, y from -2 to 4, and fits the window.
    scale = 0.92 * min(width / 8.0, height / 6.0)
    x, y = left + width / 2 + (5.0 - 3.0) * scale, top + height / 2 - (2.5 - 1.0) * scale
    page.click(x, y)
    page.wait(f"{CARD}.includes('0005.jpg')")
    card = page.run(CARD)
    assert "5.0, 2.5 px" in card
    assert "loop closure" in card
    assert page.run("document.querySelectorAll('#card .off').length") == 1
    assert page.run("document.querySelector('#card img').naturalWidth") > 0
    # The wheel zooms about the mouse: the frame stays below it.
    page.mouse("mouseWheel", x, y, deltaX=0, deltaY=-600)
    page.click(left + 5, top + 5)
    page.wait(f"!{CARD}.includes('0005.jpg')")
    page.click(x, y)
    page.wait(f"{CARD}.includes('0005.jpg')")
    # A lost frame of the table, with what to try.
    page.run("document.querySelector('.section .chip').click()")
    assert "at least 15 are needed" in page.run(CARD)
    assert "More light" in page.run(CARD)
    page.run("document.getElementById('map').value = '1'")
    page.run("document.getElementById('map').dispatchEvent(new Event('change'))")
    assert page.run("document.title").startswith("drive </script>")
    assert page.run("document.getElementById('command').innerText").endswith("'a <b>&' --loops")
    page.screenshot(tmp_path / "page.png")
    assert page.errors == []
    assert page.requests == [(tmp_path / REPORT_NAME).as_uri()]


def test_a_local_server_adds_the_full_resolution(run: FinishedRun, tmp_path: Path) -> None:
    """Green tiles, of half the floor, over the brown overview; the other half was never seen."""
    write_report(tmp_path, run, Session())
    green = np.zeros((256, 256, 4), np.uint8)
    green[..., 1] = green[..., 3] = 255
    write_deep_zoom(tmp_path, "mosaic", (800, 600), 256, [(0, 0, green), (1, 0, green)])
    position = {"x_min": -1.0, "y_max": 4.0, "metres_per_pixel": 0.01, "tile_pixels": 256}
    write_position(tmp_path / "mosaic.dzi.json", {**position, "width": 800, "height": 600})
    server = open_server(tmp_path)
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        with browser(tmp_path / "profile") as page:
            page.open(server.address)
            page.wait("document.body.dataset.drawn === 'yes'")
            width, height = page.run("[floor.clientWidth, floor.clientHeight]")
            scale = 0.92 * min(width / 8.0, height / 6.0)
            x, y = (int(width / 2 + (0.0 - 3.0) * scale), int(height / 2 - (3.5 - 1.0) * scale))
            colour = COLOUR.format(x=x, y=y)
            page.wait(f"(([r, g, b]) => g > 200 && r < 100)({colour})")
            red, green_, _ = page.run(COLOUR.format(x=int(width / 2), y=y))
            assert red > green_ + 20
            assert page.errors == []
            assert page.requests
            assert all(url.startswith(server.address) for url in page.requests)
    finally:
        server.close()
        thread.join()
