"""The pose graph solved, in cases whose answer is known by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link
from slamcli.stages import posegraph
from slamcli.stages.posegraph import sparse_solver
from slamcli.stages.posegraph.marginals import diagonal_blocks

STEP = np.diag([0.001, 0.001, 0.002]) ** 2
LOOP = np.diag([0.003, 0.003, 0.005]) ** 2


@pytest.fixture(params=["scipy", "gtsam"])
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Either solver behind `posegraph.solve`."""
    if request.param == "gtsam":
        use_gtsam(monkeypatch)
    return str(request.param)


def use_gtsam(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gtsam")
    import gtsam_oracle

    monkeypatch.setattr(sparse_solver, "optimize", gtsam_oracle.optimize)
    monkeypatch.setattr(sparse_solver, "robust", gtsam_oracle.robust)


def link(a: int, b: int, pose: Pose2, sigma: float = 0.01) -> Link:
    return Link(a, b, pose, np.diag([sigma, sigma, sigma]) ** 2, 30, 0.9, "step")


def test_two_links_are_averaged_by_their_information() -> None:
    links = [link(0, 1, Pose2(1.0), sigma=0.01), link(0, 1, Pose2(1.03), sigma=0.02)]
    solution = posegraph.solve({0: Pose2(), 1: Pose2(1.0)}, links)
    assert solution.poses[1].x == pytest.approx(1.006, abs=1e-6)
    variance = 1 / (1 / 0.01**2 + 1 / 0.02**2)
    assert solution.covariances[1][0, 0] == pytest.approx(variance, rel=1e-3)


def test_a_closed_square_spreads_its_error() -> None:
    side = Pose2(1.0, 0.0, math.pi / 2)
    links = [link(i, i + 1, side) for i in range(3)] + [link(3, 0, Pose2(1.04, 0.0, math.pi / 2))]
    initial = {0: Pose2()}
    for index in range(3):
        initial[index + 1] = initial[index] @ side
    poses = posegraph.solve(initial, links).poses
    errors = [(poses[i].inverse() @ poses[(i + 1) % 4]).x - 1.0 for i in range(4)]
    assert max(abs(error) for error in errors) < 0.035
    assert (poses[0].x, poses[0].y, poses[0].theta) == pytest.approx((0, 0, 0), abs=1e-6)


def test_components_are_what_links_connect() -> None:
    links = [link(4, 2, Pose2()), link(0, 1, Pose2()), link(5, 4, Pose2())]
    assert posegraph.components([0, 1, 2, 3, 4, 5], links) == [[0, 1], [2, 4, 5], [3]]


def test_covariance_is_carried_along_a_lever() -> None:
    # A heading sigma of 0.1 rad at a, 2 m ahead: 0.2 m sideways at b.
    carried = posegraph.compose_covariance(np.diag([0.0, 0.0, 0.01]), Pose2(2.0), np.zeros((3, 3)))
    assert math.sqrt(carried[1, 1]) == pytest.approx(0.2)
    assert carried[0, 0] == pytest.approx(0.0, abs=1e-12)
    random = np.random.default_rng(0)
    a_from_b = Pose2(0.4, -0.7, 0.9)
    root = 0.01 * random.normal(size=(3, 3))
    covariance = root @ root.T
    samples = random.multivariate_normal(np.zeros(3), covariance, size=20_000)
    ends = [a_from_b.inverse() @ Pose2(*sample) @ a_from_b for sample in samples]
    measured = np.cov(np.array([(p.x, p.y, p.theta) for p in ends]).T)
    np.testing.assert_allclose(
        measured,
        posegraph.compose_covariance(covariance, a_from_b, np.zeros((3, 3))),
        atol=0.05 * np.abs(measured).max(),
    )


def lawnmower(count: int, lane_poses: int) -> list[Pose2]:
    poses = []
    for index in range(count):
        lane, along = divmod(index, lane_poses)
        forward = lane % 2 == 0
        x = 0.1 * (along if forward else lane_poses - 1 - along)
        poses.append(Pose2(x, 0.3 * lane, 0.0 if forward else math.pi))
    return poses


def measured(
    truth: list[Pose2],
    lane_poses: int,
    generator: np.random.Generator,
    loop_covariance: np.ndarray = LOOP,
) -> tuple[dict[int, Pose2], list[Link]]:
    """Steps to the next two poses and loops to the lane before, with the noise that they claim."""

    def noisy(a: int, b: int, covariance: np.ndarray, kind: str) -> Link:
        error = Pose2(*generator.multivariate_normal(np.zeros(3), covariance))
        motion = truth[a].inverse() @ truth[b] @ error
        return Link(a, b, motion, covariance, 30, 0.9, kind)  # type: ignore[arg-type]

    count = len(truth)
    links = [noisy(i, i + 1, STEP, "step") for i in range(count - 1)]
    links += [noisy(i, i + 2, STEP, "step") for i in range(count - 2)]
    for index in range(lane_poses, count, 3):
        before = index - 1 - 2 * (index % lane_poses)
        if index - before > 3:
            links.append(noisy(before, index, loop_covariance, "loop"))
    initial = {0: Pose2()}
    for index in range(count - 1):
        initial[index + 1] = initial[index] @ links[index].a_from_b
    return initial, links


def false_loops(count: int, number: int, generator: np.random.Generator) -> list[Link]:
    ends = [sorted(generator.choice(count, 2, replace=False).tolist()) for _ in range(number)]
    motions = generator.normal(0.0, 0.3, (number, 3))
    return [
        Link(a, b, Pose2(*motion), LOOP, 30, 0.9, "loop")
        for (a, b), motion in zip(ends, motions, strict=True)
    ]


def rmse(solution: posegraph.Solution, truth: list[Pose2]) -> float:
    errors = [(solution.poses[i].inverse() @ t).translation_length for i, t in enumerate(truth)]
    return math.sqrt(np.mean(np.square(errors)))


def test_false_loops_are_switched_off_as_gtsam_does(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(5)
    truth = lawnmower(200, 25)
    initial, links = measured(truth, 25, generator)
    loops = sum(link.kind == "loop" for link in links)
    false = false_loops(len(truth), loops // 4, generator)
    solutions = []
    for oracle in (False, True):
        if oracle:
            use_gtsam(monkeypatch)
        clean = posegraph.solve(initial, links)
        spoilt = posegraph.solve(initial, links + false)
        assert clean.switched_off == ()
        assert set(spoilt.switched_off) == set(range(len(links), len(links) + len(false)))
        assert rmse(spoilt, truth) <= 1.2 * rmse(clean, truth)
        solutions.append(spoilt)
    for index in range(1, len(truth)):
        apart = solutions[0].poses[index].inverse() @ solutions[1].poses[index]
        sigma = math.sqrt(np.trace(solutions[0].covariances[index][:2, :2]))
        assert apart.translation_length < 0.01 * sigma
        np.testing.assert_allclose(
            solutions[0].covariances[index], solutions[1].covariances[index], rtol=0.01, atol=1e-9
        )


def test_false_loops_across_a_long_drive_do_not_switch_off_true_ones() -> None:
    """They are so far off that they bend the whole chain in the first solutions."""
    generator = np.random.default_rng(0)
    truth = [Pose2(2.0 * pose.x, 2.0 * pose.y, pose.theta) for pose in lawnmower(600, 200)]
    initial, links = measured(truth, 200, generator, STEP)
    false = false_loops(len(truth), sum(link.kind == "loop" for link in links) // 8, generator)
    false = [replace(link, covariance=STEP) for link in false]
    solution = posegraph.solve(initial, links + false)
    assert set(solution.switched_off) == set(range(len(links), len(links) + len(false)))


def consistency(truth: list[Pose2], claimed: float, worlds: int, watched: tuple[int, ...]) -> float:
    """Mean normalised squared error of some poses; links claim so many times their variances."""
    errors = []
    for seed in range(worlds):
        initial, links = measured(truth, 8, np.random.default_rng(seed))
        links = [replace(link, covariance=claimed * link.covariance) for link in links]
        solution = posegraph.solve(initial, links)
        for index in watched:
            error = truth[index].inverse() @ solution.poses[index]
            vector = np.array([error.x, error.y, error.theta])
            errors.append(vector @ np.linalg.solve(solution.covariances[index], vector))
    return float(np.mean(errors))


def test_the_sigmas_tell_the_truth() -> None:
    """The normalised error squared averages to its 3 dimensions, over many worlds."""
    # Half as many as counted, as if both of one world were alike.
    band = 1.96 * math.sqrt(2.0 * 3.0 / 50)
    assert abs(consistency(lawnmower(24, 8), 1.0, 50, (11, 23)) - 3.0) < band


@pytest.mark.parametrize(("claimed", "alone"), [(9.0, 0.33), (0.4, 7.5)])
def test_how_links_agree_corrects_what_they_claim(claimed: float, alone: float) -> None:
    """The sigmas of poses are nearly honest where all links claim other variances than theirs."""
    measured_error = consistency(lawnmower(80, 8), claimed, 12, (23, 47, 71))
    assert abs(math.log(measured_error / 3.0)) < 0.35 * abs(math.log(alone / 3.0))


def test_one_pose_alone_is_where_it_is_held() -> None:
    alone = posegraph.solve({7: Pose2()}, [])
    assert alone.poses == {7: Pose2()}
    assert alone.variance_factor == 1.0


def test_that_a_stretch_agrees_does_not_make_it_surer() -> None:
    """Steps of one stretch may share an error that none of them shows; contradictions show."""
    truth = [Pose2(0.1 * index) for index in range(60)]
    initial, links = measured(truth, len(truth), np.random.default_rng(0))
    exact = [replace(link, a_from_b=truth[link.a].inverse() @ truth[link.b]) for link in links]
    assert posegraph.solve(initial, exact).variance_factor == 1.0
    bold = [replace(link, covariance=0.25 * link.covariance) for link in links]
    assert posegraph.solve(initial, bold).variance_factor == pytest.approx(4.0, rel=0.3)


def test_what_is_known_across_a_slanting_line_alone_is_kept(solver: str) -> None:
    """A link that is open along a line, in axes which do not lie along it."""
    slant = math.radians(3.0)
    axes = np.array([[math.cos(slant), -math.sin(slant)], [math.sin(slant), math.cos(slant)]])
    covariance = np.diag([0.0, 0.0, 1e-8])
    covariance[:2, :2] = axes @ np.diag([1.0, 1e-9]) @ axes.T
    truth = Pose2(0.03, 0.001)
    along = Pose2(*(axes @ (0.2, 0.0)), 0.0)
    partial = Link(0, 1, truth @ along, covariance, 0, 0.9, "partial")
    felt = Link(0, 1, truth @ Pose2(0.0, 0.004, 0.01), np.diag([1e-4] * 3), 0, 0.9, "odometry")
    solved = posegraph.solve({0: Pose2(), 1: truth}, [partial, felt])
    off = truth.inverse() @ solved.poses[1]
    assert abs(-off.x * math.sin(slant) + off.y * math.cos(slant)) < 1e-4
    assert off.translation_length < 1e-3
    fused = truth.inverse() @ posegraph.fuse(felt, partial).a_from_b
    assert (off.inverse() @ fused).translation_length < 1e-5


def test_marginals_are_those_of_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")
    truth = lawnmower(40, 8)
    initial, links = measured(truth, 8, np.random.default_rng(2))
    solution = posegraph.solve(initial, links)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    firm = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), firm))
    for index, pose in solution.poses.items():
        values.insert(index, gtsam.Pose2(pose.x, pose.y, pose.theta))
    for one in links:
        noise = gtsam.noiseModel.Gaussian.Covariance(solution.variance_factor * one.covariance)
        motion = gtsam.Pose2(one.a_from_b.x, one.a_from_b.y, one.a_from_b.theta)
        graph.add(gtsam.BetweenFactorPose2(one.a, one.b, motion, noise))
    marginals = gtsam.Marginals(graph, values)
    for index, covariance in solution.covariances.items():
        expected = marginals.marginalCovariance(index)
        # GTSAM takes residuals for small in its Jacobians.
        allowed = 1e-3 * float(np.abs(expected).max())
        np.testing.assert_allclose(covariance, expected, rtol=1e-3, atol=allowed)


def test_the_inverse_is_that_of_numpy() -> None:
    generator = np.random.default_rng(0)
    sizes = np.array([3, 1, 2] * 20)
    ends = [0, *np.cumsum(sizes)]
    size = ends[-1]
    matrix = np.eye(size)
    for _ in range(90):
        chosen = generator.choice(len(sizes), 2, replace=False)
        places = np.concatenate([np.arange(ends[k], ends[k + 1]) for k in chosen])
        jacobian = generator.normal(size=(3, len(places)))
        matrix[np.ix_(places, places)] += jacobian.T @ jacobian
    rows, columns = np.nonzero(matrix)
    blocks = diagonal_blocks(rows, columns, matrix[rows, columns], sizes)
    inverse = np.linalg.inv(matrix)
    for block, begin, end in zip(blocks, ends[:-1], ends[1:], strict=True):
        np.testing.assert_allclose(block, inverse[begin:end, begin:end], atol=1e-12)


def test_a_step_that_its_neighbours_contradict_is_switched_off(solver: str) -> None:
    links = [link(i, i + 1, Pose2(1.0)) for i in range(4)]
    links += [link(i, i + 2, Pose2(2.0)) for i in range(3)]
    links[1] = link(1, 2, Pose2(1.3, 0.1, 0.2))
    initial = {i: Pose2(float(i)) for i in range(5)}
    solution = posegraph.solve(initial, links)
    assert solution.switched_off == (1,)
    assert solution.poses[4].x == pytest.approx(4.0, abs=1e-6)


def test_a_link_without_an_alternative_is_kept() -> None:
    links = [link(0, 1, Pose2(1.0)), link(1, 2, Pose2(1.0)), link(0, 2, Pose2(2.0))]
    only = Link(2, 3, Pose2(50.0, 0.0, 2.0), 1e-4 * np.eye(3), 30, 0.9, "loop")
    initial = {0: Pose2(), 1: Pose2(1.0), 2: Pose2(2.0), 3: Pose2(3.0)}
    solution = posegraph.solve(initial, [*links, only])
    assert solution.switched_off == ()
    assert solution.poses[3].x == pytest.approx(52.0, abs=1e-4)
