"""Relocalisation: a frame with no pose prior is found, or rejected with the reason."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from worlds import CAMERA, make_photographer, take

import slamcli
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2
from slamcli.core.records import Features, Frame, PoseEstimate, PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.keyframes import KeyframeDatabase, encode_keyframe
from slamcli.mapping.preprocessing import Preprocessor
from slamcli.mapping.query_frames import QueryPreprocessor
from slamcli.mapping.relocalization import Relocalizer, are_near
from slamcli.registration.marks import RepeatMarks
from slamcli.simulation.config import CameraOptions
from slamcli.stages.place_index import PlaceCandidate


class Floor:
    """An asphalt floor, a camera over it, and a map of some keyframes."""

    def __init__(self, camera: CameraOptions = CAMERA) -> None:
        self.photographer = make_photographer(camera=camera)
        self.camera = self.photographer.calibration
        self.options = slamcli.MapperOptions()
        self.preprocessor = Preprocessor(self.camera, self.options)

    def look(self, pose: Pose2, index: int) -> PreparedFrame:
        image = take(self.photographer, pose, index)
        return self.preprocessor.prepare(Frame(index, str(index), None, image))

    def map(self, keyframes: dict[Pose2, Pose2]) -> tuple[Relocalizer, PoseGraph]:
        """Keyframes taken at some poses and, by the graph, at others."""
        database = KeyframeDatabase(self.preprocessor.grid, self.options.matching.seed)
        graph = PoseGraph()
        for index, (true, mapped) in enumerate(keyframes.items()):
            database.add(encode_keyframe(self.look(true, index)))
            covariance = 1e-8 * np.eye(3)
            graph.set_estimate(
                PoseEstimate(index, str(index), None, mapped, "tracked", "", 0, covariance)
            )
        return Relocalizer(self.camera, self.options, database), graph


@pytest.fixture(scope="module")
def floor() -> Floor:
    return Floor()


def test_a_frame_is_found_at_any_heading_and_one_of_other_floor_is_not(floor: Floor) -> None:
    relocalizer, graph = floor.map({Pose2(): Pose2(), Pose2(0.1): Pose2(0.1)})
    middle = Pose2(0.22)
    truth = middle @ Pose2(0.02, 0.01, 2.0) @ middle.inverse()
    prepared = floor.look(truth, 10)
    found = relocalizer.verify(prepared, relocalizer.query(prepared.features), graph)
    assert found.link is not None
    assert found.link.kind == "loop"
    error = truth.inverse() @ graph.predict_pose(prepared, [found.link]).map_from_robot
    assert error.translation_length < 0.002
    assert abs(math.degrees(error.theta)) < 0.3
    elsewhere = floor.look(Pose2(7.0, 3.0), 11)
    missed = relocalizer.verify(elsewhere, relocalizer.query(elsewhere.features), graph)
    assert missed.link is None
    assert missed.reason.startswith("not here: no place")


def test_two_places_that_look_alike_are_ambiguous_and_one_place_is_not(floor: Floor) -> None:
    prepared = floor.look(Pose2(0.05), 9)
    # The same floor from two poses that the graph has 4 m apart, and from those it was taken at.
    for mapped, ambiguous in ((Pose2(4.0), True), (Pose2(0.02), False)):
        relocalizer, graph = floor.map({Pose2(): Pose2(), Pose2(0.02): mapped})
        found = relocalizer.verify(prepared, relocalizer.query(prepared.features), graph)
        assert ("ambiguous: 2 places" in found.reason) == ambiguous
        assert (found.link is None) == ambiguous


def test_candidates_that_lead_to_one_place_are_one(
    floor: Floor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Votes are rough: two places by the votes may be one by the registrations."""
    relocalizer, graph = floor.map({Pose2(): Pose2(), Pose2(0.02): Pose2(0.02)})
    true = {0: Pose2(0.05), 1: Pose2(0.03)}
    candidates = [PlaceCandidate(0, true[0], 9), PlaceCandidate(1, true[1] @ Pose2(0.5), 9)]
    register = relocalizer.register_reliably
    monkeypatch.setattr(
        relocalizer, "register_reliably", lambda a, now, _: register(a, now, true[a])
    )
    assert relocalizer.verify(floor.look(Pose2(0.05), 9), candidates, graph).link is not None


def test_a_keyframe_without_a_pose_is_no_place(floor: Floor) -> None:
    relocalizer, graph = floor.map({Pose2(): Pose2()})
    graph.set_estimate(PoseEstimate(0, "0", None, None, "lost", "unknown"))
    prepared = floor.look(Pose2(0.02), 9)
    assert relocalizer.query(prepared.features)
    found = relocalizer.verify(prepared, relocalizer.query(prepared.features), graph)
    assert found.reason.startswith("not here: no place")


def test_only_a_registration_with_many_inliers_is_reliable(floor: Floor) -> None:
    relocalizer, _ = floor.map({Pose2(): Pose2()})
    prepared = floor.look(Pose2(0.02), 9)
    result = relocalizer.register_reliably(0, prepared, Pose2(0.02))
    by_guess = relocalizer.register(0, prepared, Pose2(0.02))
    assert result is not None
    assert result.link is not None
    assert by_guess.link is not None
    assert result.link.a_from_b == by_guess.link.a_from_b
    strict = slamcli.MapperOptions(
        matching=slamcli.MatchOptions(min_inliers=result.alignment.inlier_count // 2)
    )
    database = relocalizer.database
    strictly = Relocalizer(floor.camera, strict, database)
    assert strictly.register_reliably(0, prepared, Pose2(0.02)) is None


@pytest.mark.parametrize("repeats", [False, True])
def test_a_frame_is_found_on_a_floor_that_repeats_only_by_its_marks(
    monkeypatch: pytest.MonkeyPatch, floor: Floor, repeats: bool
) -> None:
    relocalizer, _ = floor.map({Pose2(): Pose2()})
    prepared = floor.look(Pose2(0.02), 9)
    if repeats:
        period = Deferred.of(np.array([[5.0, 0.0]]))
        prepared = replace(prepared, periodicity=period)
    for supported in (True, False):
        monkeypatch.setattr(RepeatMarks, "support", lambda *given, value=supported, alone: value)
        found = relocalizer.register_reliably(0, prepared, Pose2(0.02))
        assert (found is not None) is (supported or not repeats)


def test_poses_are_near_within_a_distance_and_an_angle() -> None:
    here = Pose2(1.0, 2.0, 3.1)
    assert are_near(here, here @ Pose2(0.03, 0.04, 0.09), 0.051, 0.1)
    assert not are_near(here, here @ Pose2(0.03, 0.04, 0.09), 0.049, 0.1)
    assert not are_near(here, here @ Pose2(0.03, 0.04, -0.11), 0.051, 0.1)


def test_half_the_resolution_decides_nothing_on_a_floor_that_repeats() -> None:
    floor = Floor(replace(CAMERA, size=(640, 480)))
    relocalizer, graph = floor.map({Pose2(): Pose2()})
    truth = Pose2(0.05, 0.01, 0.2)
    image = take(floor.photographer, truth, 9)
    prepared = QueryPreprocessor(floor.camera, floor.options).prepare(Frame(9, "9", None, image))
    found = relocalizer.find_by_pixels(prepared, graph)
    assert found is not None
    assert found.link is not None
    assert (truth.inverse() @ found.link.a_from_b).translation_length < 0.0005
    # Neither where it repeats, nor where fewer features agree than without pixels are required.
    keyframe = relocalizer.database.decode_halved(0)
    keyframe.periodicity._value = np.array([[0.1, 0.0]])
    assert relocalizer.find_by_pixels(prepared, graph) is None
    keyframe.periodicity._value = np.empty((0, 2))
    few = replace(prepared, extraction=Deferred.of(first_of(prepared.features, 30)))
    assert relocalizer.find_by_pixels(few, graph) is None
    # Nor where another place of the map looks like it too.
    twice, graph = floor.map({Pose2(): Pose2(), Pose2(0.01): Pose2(4.0)})
    assert twice.find_by_pixels(prepared, graph) is None


def first_of(features: Features, count: int) -> Features:
    names = [field.name for field in fields(features) if field.name != "norm"]
    return replace(features, **{name: getattr(features, name)[:count] for name in names})
