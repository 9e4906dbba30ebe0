"""report.html: one page that shows a map, how every frame came into it, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slamcli.run.report import page
from slamcli.run.report.camera import camera_table
from slamcli.run.report.frames import frame_table, link_table, map_list
from slamcli.run.report.pictures import frame_pictures
from slamcli.run.report.remedies import lost_groups
from slamcli.run.report.run import FinishedRun
from slamcli.run.report.sensors import sensor_agreement
from slamcli.run.session.session import Session

REPORT_NAME = "report.html"


def write_report(
    folder: Path, run: FinishedRun, session: Session, kept: Mapping[int, str] | None = None
) -> tuple[str, ...]:
    """Write report.html, the same bytes for any number of workers.

    Parameters
    ----------
    folder : Path
    run : FinishedRun
    session : Session
    kept : mapping of int to str, or None
        From `KeptPictures`.

    Returns
    -------
    tuple of str
        Names of frames that have a pose but could not be read again.
    """
    pictures, unread = frame_pictures(run.files, run.estimates, session, kept)
    page.write_page(
        folder / REPORT_NAME,
        {
            "title": run.title,
            "unit": run.calibration.unit,
            "note": run.note,
            "rows": run.rows,
            "command": run.command,
            "maps": map_list(run),
            "frames": frame_table(run),
            "links": link_table(run),
            "pictures": pictures,
            "lost": lost_groups(run.estimates),
            "sensors": sensor_agreement(run),
            "camera": camera_table(run),
        },
    )
    return unread
