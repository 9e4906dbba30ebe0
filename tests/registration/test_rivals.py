"""Rivals of a motion on floors that look like themselves, and what rules them out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import worlds
from hand_made_records import fit_of, pair_of

import slamcli
from slamcli.core.arrays import UInt8Array
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Frame, PyramidLevel, View
from slamcli.registration import criteria, rivals
from slamcli.registration.hypothesis import PyramidPair, photometric_score, score_refined
from slamcli.registration.marks import MarkCount, RepeatMarks
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import FloorOptions
from slamcli.stages import dense

METRES_PER_PIXEL = 0.001
TILE = 100
SIDE = 500


def tiles(marks: int, seed: int = 1) -> UInt8Array:
    """Return a floor of tiles of one print, 10 cm wide, with marks of 6 mm on each."""
    generator = np.random.default_rng(seed)
    print_of_tile = cv2.GaussianBlur(generator.normal(0.0, 60.0, (TILE, TILE)), (0, 0), 3.0)
    floor = np.tile(150.0 + print_of_tile, (12, 12))
    floor[::TILE], floor[:, ::TILE] = 90.0, 90.0
    for row in range(12):
        for column in range(12):
            for x, y in generator.uniform(10, TILE - 10, (marks, 2)):
                centre = int(column * TILE + x), int(row * TILE + y)
                cv2.circle(floor, centre, 3, float(generator.uniform(70, 110)), -1)
    return np.clip(floor, 0, 255).astype(np.uint8)


def level_of(floor: UInt8Array, column: int, row: int, seed: int, blur: float) -> PyramidLevel:
    """Return half the resolution of a part of the floor, with noise, half of it blurred."""
    part = floor[row : row + SIDE, column : column + SIDE].astype(np.float64)
    if blur:
        part[:, SIDE // 2 :] = cv2.GaussianBlur(part, (0, 0), blur)[:, SIDE // 2 :]
    part += np.random.default_rng(seed).normal(0.0, 2.0, part.shape)
    image = np.clip(part, 0, 255).astype(np.uint8)
    mask = np.full(image.shape, 255, np.uint8)
    grid = Grid(0.0, 0.0, METRES_PER_PIXEL, SIDE, SIDE)
    return dense.make_levels(View(grid, image, mask))[1]


@pytest.mark.parametrize("blur", [0.0, 1.5], ids=["sharp", "far half blurred"])
@pytest.mark.parametrize("marks", [0, 1, 3])
def test_marks_tell_a_motion_from_the_one_a_tile_on(marks: int, blur: float) -> None:
    floor = tiles(marks)
    a, b = level_of(floor, 200, 200, 2, blur), level_of(floor, 230, 200, 3, blur)
    motion, rival = Pose2(0.03).matrix, Pose2(0.03 + TILE * METRES_PER_PIXEL).matrix
    pro, contra = dense.distinguishing_marks(a, b, motion, rival)
    if marks:
        assert pro >= 3 * marks
        assert contra == 0
    else:
        assert max(pro, contra) <= 1
    assert dense.distinguishing_marks(a, b, rival, motion) == pytest.approx((contra, pro), abs=2)


@pytest.mark.parametrize("marks", [0, 10])
def test_marks_support_the_right_motion_alone(marks: int) -> None:
    """One tile off, all pixels but the marks' agree; no other motion need be compared."""
    surface = FloorOptions(wear=0.0, tile_metres=0.1, marks=marks)
    floor = floors.make_floor("tiles", surface, 0.001, seed=3)
    photographer = photograph.Photographer(
        photograph.World(floor), photograph.make_camera(worlds.CAMERA)
    )
    mapper = slamcli.Mapper(photographer.calibration)
    a, b = (
        mapper.prepare(Frame(i, str(i), None, worlds.take(photographer, pose, i)))
        for i, pose in enumerate((Pose2(), Pose2(0.03, 0.0, 0.02)))
    )
    pair, fits = PyramidPair(a.levels, b.levels), []
    repeat_marks = RepeatMarks(pair, a.repeats, b.repeats, mapper.calibration)
    for motion in (Pose2(0.03, 0.0, 0.02), Pose2(0.03 - 0.1, 0.0, 0.02)):
        refined = dense.refine(pair.a, pair.b, motion, mapper.calibration, 0.0)
        assert refined is not None
        assert refined.a_from_b.x == pytest.approx(motion.x, abs=0.001)
        fits.append(score_refined(pair, refined))
        assert repeat_marks.support(fits[-1]) is (marks > 0 and motion.x > 0)
    right, one_tile_off = fits
    assert repeat_marks.rule_out(one_tile_off, right) is (marks > 0)
    assert not repeat_marks.rule_out(right, one_tile_off)


def test_marks_rule_out_a_rival_that_few_of_them_support(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, rival = fit_of(), fit_of()
    none = np.zeros((0, 2))
    marks = RepeatMarks(pair_of(), none, none, photograph.make_camera(worlds.CAMERA))
    for by_fit, by_rival, ruled_out in (
        ((6, 0), (0, 2), True),
        ((5, 0), (0, 2), False),
        ((9, 3), (2, 3), True),
        ((9, 4), (2, 3), False),
        ((9, 0), (3, 5), False),
        ((9, 0), (0, 0), False),
    ):
        counts = {id(fit): MarkCount(*by_fit), id(rival): MarkCount(*by_rival)}
        monkeypatch.setattr(RepeatMarks, "count", lambda own, one, by=counts: by[id(one)])
        assert marks.rule_out(rival, fit) is ruled_out


def test_views_that_share_no_floor_show_no_marks() -> None:
    floor = tiles(3)
    a, b = level_of(floor, 200, 200, 2, 0.0), level_of(floor, 230, 200, 3, 0.0)
    assert dense.distinguishing_marks(a, b, Pose2(0.03).matrix, Pose2(5.0).matrix) == (0, 0)


def test_a_floor_suggests_its_periods_in_either_view() -> None:
    fit = Pose2(0.1, 0.0, 0.5)
    found = rivals.starts(fit, np.array([[0.3, 0.0]]), np.array([[0.0, 0.2]]))
    assert len(found) == 4
    assert {*found[:2]} == {fit @ Pose2(0.0, 0.2), fit @ Pose2(0.0, -0.2)}
    assert {round(pose.x, 9) for pose in found[2:]} == {0.4, -0.2}


def test_a_prior_expects_or_excludes_by_its_spread() -> None:
    prior = dense.MotionPrior(Pose2(0.1), np.diag([0.01, 0.02, 0.03]) ** 2)
    assert rivals.is_expected(prior, Pose2(0.127))
    assert not rivals.is_expected(prior, Pose2(0.129))
    assert not rivals.is_excluded(prior, Pose2(0.159))
    assert rivals.is_excluded(prior, Pose2(0.161))
    assert rivals.is_excluded(prior, Pose2(0.1, 0.0, 0.181))
    assert not rivals.is_expected(None, Pose2(0.1))
    assert not rivals.is_excluded(None, Pose2(9.0))


def test_rivals_are_refined_motions_other_than_the_fit_each_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ends = {0.4: Pose2(0.41), 0.8: Pose2(0.41), 0.6: Pose2(0.05), -0.2: Pose2(-0.2)}

    def refine(a: object, b: object, start: Pose2, *others: object) -> dense.PhotometricFit | None:
        if round(start.x, 1) not in ends:
            return None
        end, nothing = ends[round(start.x, 1)], np.zeros(0)
        return dense.PhotometricFit(end, np.eye(3), np.eye(3), end.matrix, nothing, nothing, False)

    monkeypatch.setattr(dense, "refine", refine)
    monkeypatch.setattr(rivals, "score_refined", lambda pair, refined: refined.a_from_b)
    monkeypatch.setattr(criteria, "explains_more", lambda fit, rival: False)
    starts = [Pose2(x) for x in (0.4, 0.42, 0.6, 0.8, 1.2, -0.2)]
    fit = photometric_score(pair_of(), Pose2(0.05), np.eye(3), Pose2(0.05).matrix)
    found = list(rivals.refined(pair_of(), fit, starts, None))  # type: ignore[arg-type]
    assert found == [Pose2(0.41), Pose2(-0.2)]
