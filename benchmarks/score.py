"""Fit of the score of a motion to simulated drives, cross-validated over floors.

Run: python benchmarks/score.py [--floors a,b] [--disturbances c,d] [--frames N] [--workers N].
Every comparison that the mapper makes on the drives of `robustness.py`, with another seed, counts,
and those of each frame with the next one and with others that show other floor, without a motion
prior. Printed: the weights, in the order of `slamcli.registration.confidence.EVIDENCE`, and
how often motions of each score are right when the score is fitted to all other floors.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray
from robustness import DISTURBANCES, FRAME_RATE_HERTZ, WORLDS, is_false, take_frames
from scipy.optimize import minimize

from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.mapping.mapper import Mapper
from slamcli.registration import RegistrationResult, confidence, register
from slamcli.stages import dense

FLOORS = "course,asphalt,carpet,tiles,planks,terrazzo,bare,textureless-course,five-prints"
KINDS = "none,motion-blur,noise,legs,low-overlap,rocking"
SEED = 7
# Frames so far apart show other floor.
FAR = 12
STIFFNESS = 1.0
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)


def comparisons(job: tuple[str, str, int]) -> tuple[str, list[tuple[NDArray[np.float64], bool]]]:
    """Return the evidence for every motion of one drive, and whether it is right."""
    floor, kind, count = job
    cv2.setNumThreads(1)
    calibration, truth, images = take_frames(WORLDS[floor], DISTURBANCES[kind], count, SEED)
    mapper = Mapper(calibration)
    prepared = [
        mapper.prepare(Frame(index, f"{index:04d}", index / FRAME_RATE_HERTZ, image))
        for index, image in enumerate(images)
    ]
    results: list[RegistrationResult] = []
    for frame in prepared:
        mapper.step(frame)
        results += mapper.registrations
    results += [
        register(first, second, None, calibration, mapper.options, window=dense.SearchWindow())
        for apart in (1, FAR)
        for first, second in zip(prepared, prepared[apart:], strict=False)
    ]
    return floor, [
        (result.evidence, is_right(result, truth))
        for result in results
        if result.evidence is not None
    ]


def is_right(result: RegistrationResult, truth: list[Pose2]) -> bool:
    """Return whether a result's motion is near enough to the true one."""
    assert result.fit is not None
    true = truth[result.keyframe.index].inverse() @ truth[result.prepared.index]
    return not is_false(true.inverse() @ result.fit.pose)


def fit(evidence: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weights of a logistic regression with a weak ridge prior."""
    sign = np.where(right, 1.0, -1.0)

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = sign * (evidence @ weights)
        slope = -sign / (1.0 + np.exp(np.minimum(margin, 700.0)))
        penalty = 0.5 * STIFFNESS * float(weights[1:] @ weights[1:])
        gradient = slope @ evidence + STIFFNESS * np.r_[0.0, weights[1:]]
        return float(np.sum(np.logaddexp(0.0, -margin))) + penalty, gradient

    return np.asarray(minimize(loss, np.zeros(evidence.shape[1]), jac=True).x)


def main() -> None:
    """Collect, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--floors", default=FLOORS, help=", ".join(WORLDS))
    parser.add_argument("--disturbances", default=KINDS)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    cells = product(arguments.floors.split(","), arguments.disturbances.split(","))
    jobs = [(floor, kind, arguments.frames) for floor, kind in cells]
    floors, rows, right = [], [], []
    with ProcessPoolExecutor(arguments.workers) as executor:
        for floor, found in executor.map(comparisons, jobs):
            floors += [floor] * len(found)
            rows += [evidence for evidence, _ in found]
            right += [true for _, true in found]
    names, evidence, true = np.array(floors), np.array(rows), np.array(right)
    print(f"{len(true)} motions, {np.mean(true):.0%} of them right")
    for name, weight in zip(confidence.EVIDENCE, fit(evidence, true), strict=True):
        print(f"{weight:8.2f}  {name}")
    predicted = np.zeros(len(true))
    for floor in dict.fromkeys(floors):
        held_out = names == floor
        weights = fit(evidence[~held_out], true[~held_out])
        predicted[held_out] = 1.0 / (1.0 + np.exp(-evidence[held_out] @ weights))
    print("| score | motions | predicted right | right |\n|---|---|---|---|")
    for low, high in pairwise(BINS):
        inside = (predicted >= low) & (predicted <= high if high == 1.0 else predicted < high)
        if inside.any():
            shares = f"{np.mean(predicted[inside]):.1%} | {np.mean(true[inside]):.1%}"
            print(f"| {low} to {high} | {np.count_nonzero(inside)} | {shares} |")


if __name__ == "__main__":
    main()
