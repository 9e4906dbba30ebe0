"""The pose graph for other solvers: g2o's text format, and links.csv."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Container, Mapping, Sequence
from pathlib import Path

import numpy as np

from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import Link
from slamcli.io.files import write_text

LINK_COLUMNS = ("a", "b", "kind", "x", "y", "heading", "inliers", "score", "used")


def write_g2o(path: Path, poses: Mapping[int, Pose2], links: Sequence[Link]) -> None:
    """Write a vertex a pose and an edge a link, with its information matrix.

    Kuemmerle et al., g2o: A general framework for graph optimization, ICRA 2011: ``VERTEX_SE2 id x
    y theta``; ``EDGE_SE2 a b x y theta`` and the upper triangle of the inverse covariance, in b's
    own axes, row by row. Metres and radians. ``FIX`` fixes the first pose.

    Parameters
    ----------
    path : Path
    poses : mapping of frame index to ``map_from_robot``
    links : sequence of Link
        Those with an end outside `poses` are left out.
    """
    lines = [
        f"VERTEX_SE2 {index} {pose.x:.9f} {pose.y:.9f} {pose.theta:.12f}"
        for index, pose in sorted(poses.items())
    ]
    for link in links:
        if link.a in poses and link.b in poses:
            motion = link.a_from_b
            information = invert(link.covariance)[np.triu_indices(3)]
            numbers = " ".join(f"{value:.9g}" for value in information)
            lines.append(
                f"EDGE_SE2 {link.a} {link.b} {motion.x:.9f} {motion.y:.9f} {motion.theta:.12f} "
                f"{numbers}"
            )
    if poses:
        # At the end: GTSAM's reader takes no edges after a line that it does not know.
        lines.append(f"FIX {min(poses)}")
    write_text(path, "\n".join(lines) + "\n")


def write_links(path: Path, links: Sequence[Link], switched_off: Container[int]) -> None:
    """Write a row a link: frames a and b, the motion ``a_from_b`` (m, rad), whether it was used.

    Parameters
    ----------
    path : Path
    links : sequence of Link
    switched_off : container of int
        Indices into `links` of those that the others contradict, and that were not used.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(LINK_COLUMNS)
    for index, link in enumerate(links):
        motion = link.a_from_b
        numbers = (f"{motion.x:.6f}", f"{motion.y:.6f}", f"{motion.theta:.7f}")
        score = "" if math.isnan(link.score) else f"{link.score:.4f}"
        used = "no" if index in switched_off else "yes"
        writer.writerow((link.a, link.b, link.kind, *numbers, link.inliers, score, used))
    write_text(path, stream.getvalue())
