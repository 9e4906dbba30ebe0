"""Lost frames of a finished map, registered again, on a simulated floor whose truth is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from worlds import error_of, make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, PreparedFrame
from slamcli.simulation import photograph

TRUTH = [Pose2(0.03 * i, 0.002 * i * i, 0.06 * i) for i in range(12)]
ELSEWHERE = Pose2(2.0, 1.0, 0.5)


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer()


def map_without(
    photographer: photograph.Photographer, hidden: Sequence[int]
) -> tuple[slamcli.Mapper, Callable[[Sequence[int]], list[PreparedFrame]]]:
    """Return a mapper to which some frames showed other floor, and what prepares these anew."""
    mapper = slamcli.Mapper(photographer.calibration)
    for index, pose in enumerate(TRUTH):
        at = Pose2(3.0 + index, 4.0) if index in hidden else pose
        mapper.update(Frame(index, str(index), float(index), take(photographer, at, index)))

    def prepare_again(indices: Sequence[int]) -> list[PreparedFrame]:
        pictures = [(i, take(photographer, TRUTH[i], i)) for i in indices]
        return [mapper.prepare(Frame(i, str(i), float(i), picture)) for i, picture in pictures]

    return mapper, prepare_again


@pytest.mark.parametrize("hidden", [[4], [11], [4, 5]])
def test_a_lost_frame_is_placed_where_those_around_it_predict_it(
    photographer: photograph.Photographer, hidden: list[int]
) -> None:
    mapper, prepare_again = map_without(photographer, hidden)
    assert {e.index for e in mapper.finish() if e.status == "lost"} == set(hidden)
    estimates = mapper.finish(prepare_again=prepare_again)
    assert max(error_of(e, t)[0] for e, t in zip(estimates, TRUTH, strict=True)) < 0.001
    assert {estimate.fragment for estimate in estimates} == {0}
    assert all(estimate.odom_from_robot is not None for estimate in estimates)


def test_a_first_frame_is_placed_by_those_after_it(photographer: photograph.Photographer) -> None:
    mapper, prepare_again = map_without(photographer, [0])
    estimates = mapper.finish(prepare_again=prepare_again)
    assert estimates[0].status == "tracked"
    start = estimates[0].map_from_robot
    assert start is not None
    for estimate, pose in zip(estimates, TRUTH, strict=True):
        assert estimate.map_from_robot is not None
        error = pose.inverse() @ start.inverse() @ estimate.map_from_robot
        assert error.translation_length < 0.001


def test_a_frame_that_fits_nothing_stays_lost_and_is_read_once(
    photographer: photograph.Photographer,
) -> None:
    mapper, _ = map_without(photographer, [4])
    read: list[int] = []

    def prepare_again(indices: Sequence[int]) -> list[PreparedFrame]:
        read.extend(indices)
        picture = take(photographer, ELSEWHERE, 4)
        return [mapper.prepare(Frame(i, str(i), float(i), picture)) for i in indices]

    estimates = mapper.finish(prepare_again=prepare_again)
    assert estimates[4].status == "lost"
    assert estimates[4].reason
    mapper.finish(prepare_again=prepare_again)
    assert read == [4]


def test_a_frame_that_cannot_be_read_again_stays_lost(
    photographer: photograph.Photographer,
) -> None:
    mapper, _ = map_without(photographer, [4])

    def prepare_again(indices: Sequence[int]) -> list[PreparedFrame]:
        return [PreparedFrame(i, str(i), None, None, None, "gone") for i in indices]

    estimates = mapper.finish(prepare_again=prepare_again)
    assert estimates[4].status == "lost"
    assert estimates[4].reason != "gone"


def test_no_frame_is_predicted_far_from_those_that_are_placed(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    for index, pose in enumerate(TRUTH):
        mapper.update(Frame(index, str(index), None, take(photographer, pose, index)))
    blank = np.full((240, 320), 90, np.uint8)
    for index in range(len(TRUTH), len(TRUTH) + 20):
        mapper.update(Frame(index, str(index), None, np.roll(blank, index)))
    read: list[int] = []

    def prepare_again(indices: Sequence[int]) -> list[PreparedFrame]:
        read.extend(indices)
        return []

    mapper.finish(prepare_again=prepare_again)
    assert read
    assert max(read) < len(TRUTH) + 4
