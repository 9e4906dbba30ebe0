"""The solved map as the judge of its links: what contradicts it, and what alone holds a part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, LinkKind, PreparedFrame
from slamcli.core.telemetry import OdometryReading
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.backend.sensors import Sensors

RANGE_METRES = 1.2
STEP = Pose2(0.05)
COVARIANCE = np.diag([1e-4, 1e-4, 2e-4]) ** 2
WRONG = Pose2(0.0135)


def motion(a: int, b: int) -> Pose2:
    return Pose2(STEP.x * (b - a))


def link(
    a: int, b: int, error: Pose2 | None = None, score: float = 0.99, kind: LinkKind = "step"
) -> Link:
    return Link(a, b, motion(a, b) @ (error or Pose2()), COVARIANCE, 99, score, kind)


def solved(count: int, links: list[Link], *, odometry: bool = False) -> Backend:
    """Return the back end of frames in a line, each tracked, after the final solution."""
    sensors = Sensors()
    backend = Backend(sensors, RANGE_METRES)
    placed: set[int] = set()
    for index in range(count):
        if odometry:
            sensors.odometry(OdometryReading(float(index), motion(0, index)))
        frame = PreparedFrame(index, f"{index}", float(index), None, None)
        own = [one for one in links if one.b == index and one.a in placed]
        if own:
            backend.place(frame, own)
        else:
            backend.begin_fragment(frame)
        placed.add(index)
    backend.solve([one for one in links if one.a > one.b])
    return backend


def chain(first: int, last: int, *, leave: tuple[int, ...] = ()) -> list[Link]:
    """Return links from each frame to the two after it, but for some frames."""
    frames = [index for index in range(first, last + 1) if index not in leave]
    return [link(a, b) for place, a in enumerate(frames) for b in frames[place + 1 : place + 3]]


def off_metres(backend: Backend, frames: range) -> float:
    poses = [(index, backend.graph[index].map_from_robot) for index in frames]
    first = backend.graph.pose(frames[0])
    return max(
        ((first @ motion(frames[0], index)).inverse() @ pose).translation_length
        for index, pose in poses
        if pose is not None
    )


def test_a_frame_whose_links_contradict_one_another_is_lost_and_bends_nothing() -> None:
    links = [*chain(0, 9, leave=(5,)), link(4, 5), link(6, 5, WRONG)]
    backend = solved(10, links)
    lost = backend.graph[5]
    assert (lost.status, lost.map_from_robot) == ("lost", None)
    assert lost.reason.startswith("its links contradict one another")
    assert {backend.graph[index].fragment for index in range(10) if index != 5} == {0}
    assert off_metres(backend, range(10)) < 1e-4
    assert {backend.graph.links[n].b for n in backend.graph.switched_off} == {5}


def test_of_two_links_that_contradict_one_another_the_clearly_likelier_one_stays() -> None:
    for scores in ((0.999, 0.6), (0.6, 0.999)):
        right, wrong = scores
        false = [link(4, 5, WRONG, wrong), link(6, 5, None, right)]
        backend = solved(10, [*chain(0, 9, leave=(5,)), *false])
        assert off_metres(backend, range(10)) == pytest.approx(
            0.0 if right > wrong else WRONG.x, abs=1e-4
        )
        # What is left places it: the score is no higher than that of the link that does.
        assert backend.graph[5].score == pytest.approx(max(scores))


def test_a_frame_with_one_link_off_has_no_score_of_it() -> None:
    links = [*chain(0, 9), link(2, 7, WRONG, 0.9999, "loop")]
    links = [replace(one, score=0.95) if one.kind == "step" else one for one in links]
    backend = solved(10, links)
    assert [backend.graph.links[n].kind for n in backend.graph.switched_off] == ["loop"]
    assert backend.graph[7].score == pytest.approx(0.95)
    assert off_metres(backend, range(10)) < 1e-4


def test_odometry_decides_between_links_that_contradict_one_another() -> None:
    links = [*chain(0, 9, leave=(5,)), link(4, 5, Pose2(0.2)), link(6, 5)]
    backend = solved(10, links, odometry=True)
    assert backend.graph[5].status == "tracked"
    assert off_metres(backend, range(10)) < 1e-3


@pytest.mark.parametrize(
    ("loops", "fragments"),
    [
        ([(2, 12, 0.6)], {0, 1}),
        ([(2, 12, 0.95)], {0}),
        ([(2, 12, 0.6), (3, 13, 0.6)], {0}),
    ],
)
def test_a_fragment_joined_by_one_weak_link_stays_apart(
    loops: list[tuple[int, int, float]], fragments: set[int]
) -> None:
    links = [*chain(0, 9), *chain(10, 19)]
    links += [link(b, a, None, score, "loop") for a, b, score in loops]
    backend = solved(20, links)
    assert {backend.graph[index].fragment for index in range(20)} == fragments


def test_a_fragment_joined_by_two_links_that_contradict_one_another_stays_apart() -> None:
    links = [*chain(0, 9), *chain(10, 19)]
    links += [link(12, 2, None, 0.95, "loop"), link(13, 3, Pose2(0.3), 0.96, "loop")]
    backend = solved(20, links)
    assert {backend.graph[index].fragment for index in range(20)} == {0, 1}
    for part in (range(10), range(10, 20)):
        assert off_metres(backend, part) < 1e-4


def test_small_differences_between_links_leave_nothing_out() -> None:
    """Of a camera that rocks links are off by more than their sigmas, and right all the same."""
    links = [*chain(0, 9, leave=(5,)), link(4, 5), link(6, 5, Pose2(0.005))]
    backend = solved(10, links)
    assert backend.graph[5].status == "tracked"
    assert off_metres(backend, range(10)) < 0.006


def test_an_unlikely_link_is_not_used_for_a_frame_that_another_one_places() -> None:
    steps = [link(0, 1), link(0, 2, WRONG, score=0.6), link(1, 2)]
    backend = solved(3, steps)
    assert [(one.a, one.b) for one in backend.graph.links] == [(0, 1), (1, 2)]
    assert off_metres(backend, range(3)) < 1e-9
    alone = solved(2, [link(0, 1, score=0.6)])
    assert [(one.a, one.b) for one in alone.graph.links] == [(0, 1)]
