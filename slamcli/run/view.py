"""`slam view`: the report of a map in the browser, with its pyramid of tiles where there is one."""

from __future__ import annotations

import base64
import json
import re
import webbrowser
from dataclasses import dataclass
from pathlib import Path

from slamcli.core.errors import InputError
from slamcli.io.files import read_text
from slamcli.io.loopback import Answer, LoopbackServer
from slamcli.io.raster.deepzoom import read_position
from slamcli.run.command_report import Report
from slamcli.run.report import REPORT_NAME
from slamcli.run.rerun_export import export_rerun

_TILE = re.compile(r"/(mosaic(?:_\d+)?_files/\d+/\d+_\d+\.png)")
_NAME = re.compile(r"mosaic(?:_(\d+))?\.dzi\.json")
# For places where nothing was seen, which a pyramid leaves out: one transparent pixel.
_NOTHING = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNkYPhfDwAChwGA60e6kgAAAABJRU5ErkJg"
    "gg=="
)


@dataclass(frozen=True, slots=True, eq=False)
class View(Report):
    """The address of a report, or what a recording has.

    Attributes
    ----------
    server : LoopbackServer or None
        Of the report.
    browser : bool
        Open it in the user's browser.
    """

    server: LoopbackServer | None = None
    browser: bool = False

    def serve(self) -> None:
        """Serve the report, if there is one to serve, until the user interrupts."""
        if self.server is None:
            return
        if self.browser:
            webbrowser.open(self.server.address)
        self.server.serve()


def view(
    run: Path,
    *,
    port: int,
    browser: bool,
    rerun: Path | None = None,
    overwrite: bool = False,
) -> View:
    """Open a server of a run's report on this machine, or write a recording of the run.

    Parameters
    ----------
    run : Path
        Output folder of `slam stitch`, or a file in it.
    browser : bool
        Open it in the user's browser.
    rerun : Path or None
        Write a recording for rerun's viewer instead.
    overwrite : bool
        Replace an earlier recording.

    Raises
    ------
    InputError, MapError, OutputError
    """
    if rerun is not None:
        lines = export_rerun(run, rerun, overwrite=overwrite)
        return View(tuple(lines), {"recording": rerun, "notes": lines[:-1]})
    server = open_server(run, port)
    line = f"{server.address} shows {run}; Ctrl-C ends it"
    facts = {"address": server.address, "run": run}
    return View((line,), facts, server=server, browser=browser)


def open_server(run: Path, port: int = 0) -> LoopbackServer:
    """Return a server of a run's report and of its tiles.

    Raises
    ------
    InputError
        When there is no report, or the port is taken.
    """
    folder = run if run.is_dir() else run.parent
    path = folder / REPORT_NAME
    if not path.is_file():
        raise InputError(f"{folder} has no {REPORT_NAME}; give the output folder of slam stitch")
    page = _page(path, folder)

    def answer(name: str) -> Answer | None:
        if name in {"/", f"/{REPORT_NAME}"}:
            return Answer("text/html; charset=utf-8", page)
        tile = _TILE.fullmatch(name)
        if tile is None:
            return None
        try:
            return Answer("image/png", (folder / tile[1]).read_bytes())
        except OSError:  # nothing was seen there
            return Answer("image/png", _NOTHING)

    return LoopbackServer(answer, port)


def _page(path: Path, folder: Path) -> bytes:
    """Return the report, which may also load the tiles that it finds described in it."""
    text = read_text(path, "report")
    tiles = {}
    for described in sorted(folder.glob("mosaic*.dzi.json")):
        name = _NAME.fullmatch(described.name)
        if name is not None:
            position = read_position(described)
            tiles[name[1] or "0"] = {
                "url": f"{described.name.removesuffix('.dzi.json')}_files",
                "x": position["x_min"],
                "y": position["y_max"],
                "scale": position["metres_per_pixel"],
                "width": position["width"],
                "height": position["height"],
                "tile": position["tile_pixels"],
            }
    text = text.replace('id="tiles">{}<', f'id="tiles">{json.dumps(tiles)}<', 1)
    return text.replace("img-src data:", "img-src data: 'self'", 1).encode()
