"""report.html: its data, its bytes, and its size."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import PoseEstimate
from slamcli.io.frames import list_frames, read_frame
from slamcli.run.report import REPORT_NAME, pictures, write_report
from slamcli.run.report.frames import link_residuals
from slamcli.run.report.remedies import lost_groups, message_of, remedies
from slamcli.run.report.run import FinishedRun
from slamcli.run.session.session import Session


def data_of(folder: Path) -> Any:
    page = (folder / REPORT_NAME).read_text(encoding="utf-8")
    block = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert block
    return json.loads(block[1])


def test_it_has_every_frame_link_picture_and_lost_group(run: FinishedRun, tmp_path: Path) -> None:
    write_report(tmp_path, run, Session())
    data = data_of(tmp_path)
    assert [row[2] for row in data["frames"]].count("lost") == 3
    assert data["frames"][5][5:7] == [5.0, 2.5]
    # The one that cannot be read has none.
    assert sorted(map(int, data["pictures"])) == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert [one["frames"] for one in data["maps"]] == [5, 2]
    assert [row[3] for row in data["links"]] == [0, 0, 0, 1]
    groups = [(group["reason"], group["frames"]) for group in data["lost"]]
    assert groups == [
        ("… features; at least … are needed", [3, 7]),
        ("the file is empty (0 bytes)", [6]),
    ]
    assert "--features sift" in data["lost"][0]["remedy"]
    assert data["command"] == "slam stitch 'a <b>&' --loops"


def test_a_residual_is_how_far_the_poses_are_from_the_link(run: FinishedRun) -> None:
    """The first link says one centimetre more than the poses, which is one of its sigmas."""
    residuals = link_residuals(run.registered.links[:2], run.estimates)
    assert residuals[0] == pytest.approx([0.01, 0.0, 1.0], abs=1e-9)
    assert residuals[1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_no_name_of_a_file_ends_the_script_or_begins_another(
    run: FinishedRun, tmp_path: Path
) -> None:
    odd = "\u2028</SCRIPT><!--<script>&amp;\udcff.jpg"
    first = replace(run.estimates[0], name=odd)
    write_report(tmp_path, replace(run, estimates=[first, *run.estimates[1:]]), Session())
    page = (tmp_path / REPORT_NAME).read_text(encoding="utf-8")
    assert page.count("<script") == page.count("</script>") == 3
    assert "<!--" not in page
    assert data_of(tmp_path)["frames"][0][0] == odd.replace("\udcff", "\\xff")


def test_the_bytes_are_the_same_for_any_number_of_workers(run: FinishedRun, tmp_path: Path) -> None:
    pages = []
    for workers in (1, 2, 4):
        write_report(tmp_path, run, Session(workers=workers))
        pages.append((tmp_path / REPORT_NAME).read_bytes())
    assert pages[0] == pages[1] == pages[2]


def test_it_asks_the_network_for_nothing(run: FinishedRun, tmp_path: Path) -> None:
    write_report(tmp_path, run, Session())
    page = (tmp_path / REPORT_NAME).read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert not re.findall(r"https?://|src=\"(?!data:)|@import|url\(", page)


@pytest.mark.parametrize(
    ("reason", "message"),
    [
        ("overlaps no other frame", "overlaps no other frame"),
        (
            "overlaps no other frame enough; frames should overlap by a third (nearest b.jpg: "
            "pixels of the overlap differ)",
            "overlaps no other frame enough; frames should overlap by a third (nearest …: …)",
        ),
        (
            "12 inliers of 40 matches; at least 15 are needed (to 0 (1).jpg)",
            "… inliers of … matches; at least … are needed",
        ),
        ("a reason that nobody knows", "a reason that nobody knows"),
    ],
)
def test_a_reason_is_found_on_the_troubleshooting_page(reason: str, message: str) -> None:
    assert message_of(reason) == message
    assert bool(remedies().get(message)) is (message in remedies())


def test_the_advice_is_that_of_the_troubleshooting_page() -> None:
    page = Path(__file__).parents[3] / "docs" / "troubleshooting.md"
    shipped = Path(pictures.__file__).parent / "troubleshooting.md"
    assert shipped.read_bytes() == page.read_bytes()
    assert len(remedies()) > 150
    lost = PoseEstimate(0, "a", None, None, "lost", "not reached: interrupted")
    assert lost_groups([lost])[0]["remedy"]


def test_pictures_are_smaller_the_more_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of more frames than places, those without a pose get up to half of the places."""
    monkeypatch.setattr(pictures, "_MAX_PICTURES", 8)
    monkeypatch.setattr(pictures, "_SIDES", ((4, 32), (10**9, 16)))
    noise = np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8)
    for index in range(24):
        cv2.imwrite(str(tmp_path / f"{index:02d}.png"), noise)
    files = list_frames([tmp_path])
    poses = [None if index in {5, 6, 20} else Pose2() for index in range(24)]
    estimates = [
        PoseEstimate(n, "", None, pose, "tracked" if pose else "lost")
        for n, pose in enumerate(poses)
    ]
    few, _ = pictures.frame_pictures(files[:4], estimates, Session())
    many, _ = pictures.frame_pictures(files, estimates, Session())
    assert len(many) <= 8
    assert {"5", "6", "20"} <= set(many)
    assert len(few) == 4
    assert all(len(many["5"]) < len(url) for url in few.values())
    assert math.isclose(len(few["0"]), len(few["3"]))
    kept = pictures.KeptPictures(files, estimates)
    for file in files[::2]:
        kept.keep(read_frame(file, halved=True))
        file.path.unlink()
    assert 3 <= len(kept.urls) < len(many)
    assert pictures.frame_pictures(files, estimates, Session(), kept.urls)[0] == many
