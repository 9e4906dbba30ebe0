"""Fit of the score of a motion to simulated floors, each kind foretold by the others.

Run: python benchmarks/score.py --folder FOLDER [--shard I/N] [--limit N] [--summary]. A cell is a
kind of floor seen by one of five cameras, with or without disturbances: 20 frames of a short way
and around it, registered in pairs: near a right guess, one that is a period of the floor off, one
that is anywhere, and searched for, with priors that are right, wrong or absent. The evidence of
each motion, and whether it is within 2 cm and 1 degree of the truth, is kept in the folder, one
file a cell. Printed: the weights, in the order of `slamcli.registration.confidence.EVIDENCE`, and
how often motions of each score are right when it is fitted to all other kinds of floors.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from drives import Drive, make_drive
from numpy.typing import NDArray
from placements import is_false
from scipy.optimize import minimize

from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame
from slamcli.mapping.mapper import Mapper
from slamcli.registration import RegistrationResult, confidence, register
from slamcli.simulation import floors
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    FloorOptions,
    ImagingOptions,
    SimulationOptions,
)
from slamcli.stages import dense

VARIANTS = (
    SimulationOptions(
        surface=FloorOptions(tile_metres=0.1, marks=3, wear=0.5),
        camera=CameraOptions(size=(320, 240), height_metres=0.3, pitch_degrees=40.0),
    ),
    SimulationOptions(
        surface=FloorOptions(tile_metres=0.2, marks=10, wear=0.3),
        camera=CameraOptions(size=(320, 240), height_metres=0.25, pitch_degrees=32.0),
        disturbances=DisturbanceOptions(noise_gray=8.0, flicker=0.3),
    ),
    SimulationOptions(
        surface=FloorOptions(tile_metres=0.3, marks=0, wear=0.0),
        camera=CameraOptions(size=(320, 240), height_metres=0.35, pitch_degrees=45.0),
        disturbances=DisturbanceOptions(motion_blur=0.2, boxes=3, walkers=3),
    ),
    SimulationOptions(
        surface=FloorOptions(tile_metres=0.45, marks=3, wear=0.8),
        camera=CameraOptions(size=(320, 240), height_metres=0.3, pitch_degrees=38.0),
        imaging=ImagingOptions(lamp_share=0.2, auto_exposure=True, sharpening=0.4),
        disturbances=DisturbanceOptions(rocking_degrees=0.15),
    ),
    # Tiles of one print, in colour through a sensor's filter array and a dusty lens.
    SimulationOptions(
        surface=FloorOptions(tile_metres=0.15, marks=0, wear=0.2),
        camera=CameraOptions(size=(320, 240), height_metres=0.32, pitch_degrees=50.0),
        imaging=ImagingOptions(bayer=True, dust=6),
        disturbances=DisturbanceOptions(noise_gray=4.0, flicker=0.15, vignetting=0.3),
    ),
)
SEED = 11
# Frames of the way, and others around it.
ALONG, AROUND = 14, 6
COURSE_RADIUS_METRES = 0.45
RANDOM_PAIRS, SEARCHES = 300, 24
PRIOR_SIGMAS, PRIOR_SHARE = (0.01, 0.03, 0.08), 0.7
STIFFNESS = 0.3
# Of each weight: evidence for a motion never counts against it, nor the reverse.
SIGNS = np.array([0, 1, 1, 0, 1, 1, -1, -1, 1, -1, -1])
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
CALIBRATION_BINS = 20


@dataclass(frozen=True)
class Trial:
    """A pair of frames, and how far off the guess is at which their motion is looked for."""

    a: int
    b: int
    off: Pose2
    searched: bool = False


def drive_of(kind: str, variant: int, generator: np.random.Generator) -> Drive:
    """Return the frames of a cell: along a way, then around it."""
    step = float(generator.uniform(0.02, 0.10))
    turn = step / COURSE_RADIUS_METRES if kind == "course" else float(generator.normal(0.0, 0.08))
    poses = [Pose2()]
    for _ in range(ALONG - 1):
        poses.append(poses[-1] @ Pose2(step, 0.0, turn + float(generator.normal(0.0, 0.02))))
    for _ in range(AROUND):
        near = poses[int(generator.integers(0, ALONG))]
        poses.append(near @ _anywhere(generator, 0.3, 0.3, 0.5))
    return make_drive(replace(VARIANTS[variant], floor=kind, seed=100 + variant), poses)


def trials(generator: np.random.Generator, tile_metres: float) -> Iterator[Trial]:
    """Yield the pairs of a cell."""
    near = [(a, b) for a in range(ALONG) for b in range(ALONG) if a != b and abs(a - b) <= 3]
    for a, b in near:
        yield Trial(a, b, _about(generator, 0.006, 0.015))
        period = tile_metres * generator.permutation([1.0, 0.0]) * generator.choice([-1, 1])
        yield Trial(a, b, Pose2(*period.tolist(), 0.0) @ _about(generator, 0.004, 0.01))
        if abs(a - b) <= 2:
            yield Trial(a, b, _anywhere(generator, 0.25, 0.25, 0.4))
    for _ in range(RANDOM_PAIRS):
        a, b = (int(index) for index in generator.choice(ALONG + AROUND, 2, replace=False))
        right = generator.random() < 0.5
        yield Trial(
            a, b, _about(generator, 0.01, 0.03) if right else _anywhere(generator, 0.4, 0.4, 0.5)
        )
    for number in range(SEARCHES):
        a = int(generator.integers(0, ALONG - 1))
        b = min(a + int(generator.integers(1, 3)), ALONG - 1)
        pair = (b, a) if generator.random() < 0.5 else (a, b)
        wrong = number % 3 == 0
        off = _anywhere(generator, 0.15, 0.1, 0.1) if wrong else _about(generator, 0.01, 0.03)
        yield Trial(*pair, off, searched=True)


def _about(generator: np.random.Generator, metres: float, radians: float) -> Pose2:
    return Pose2(*(float(generator.normal(0.0, sigma)) for sigma in (metres, metres, radians)))


def _anywhere(generator: np.random.Generator, x: float, y: float, radians: float) -> Pose2:
    return Pose2(*(float(generator.uniform(-limit, limit)) for limit in (x, y, radians)))


def motions(
    kind: str, variant: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
    """Return the evidence about every motion of a cell, whether it is right, and its trial."""
    generator = np.random.default_rng([SEED, list(floors.FLOORS).index(kind), variant])
    drive = drive_of(kind, variant, generator)
    mapper = Mapper(drive.calibration)
    prepared = [mapper.prepare(drive.frame(index)) for index in range(ALONG + AROUND)]
    rows, right, numbers = [], [], []
    for number, trial in enumerate(list(trials(generator, VARIANTS[variant].surface.tile_metres))):
        true = drive.truth[trial.a].inverse() @ drive.truth[trial.b]
        result = _registered(mapper, prepared, trial, true @ trial.off, generator)
        if result.fit is not None and result.evidence is not None:
            rows.append(result.evidence)
            right.append(not is_false(true.inverse() @ result.fit.pose))
            numbers.append(number)
    return np.array(rows), np.array(right), np.array(numbers)


def _registered(
    mapper: Mapper,
    prepared: list[PreparedFrame],
    trial: Trial,
    guess: Pose2,
    generator: np.random.Generator,
) -> RegistrationResult:
    sigma, prior = float(generator.choice(PRIOR_SIGMAS)), None
    if generator.random() < PRIOR_SHARE:
        prior = dense.MotionPrior(guess, sigma**2 * np.eye(3))
    calibration, options = mapper.calibration, mapper.options
    pair = prepared[trial.a], prepared[trial.b]
    if not trial.searched:
        return register(*pair, guess, calibration, options, prior=prior)
    radius = options.search_share_of_range * calibration.max_range_metres
    window = dense.SearchWindow(guess, 0.35, radius)
    return register(*pair, None, calibration, options, window=window, prior=prior)


def fit(evidence: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the weights of a monotone logistic regression with a weak ridge prior."""
    pieces, share = evidence[:, :-1], 1.0 / (1.0 + evidence[:, -1])

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        alone = 1.0 / (1.0 + np.exp(-np.clip(pieces @ weights, -500.0, 500.0)))
        chance = np.clip(share * alone, 1e-12, 1.0 - 1e-12)
        slope = np.where(right, alone - 1.0, chance * (1.0 - alone) / (1.0 - chance))
        penalty = 0.5 * STIFFNESS * float(weights[1:] @ weights[1:])
        gradient = slope @ pieces + STIFFNESS * np.r_[0.0, weights[1:]]
        return -float(np.sum(np.log(np.where(right, chance, 1.0 - chance)))) + penalty, gradient

    limits = [(0.0 if sign > 0 else None, 0.0 if sign < 0 else None) for sign in SIGNS]
    found = minimize(loss, np.zeros(pieces.shape[1]), jac=True, bounds=limits, method="L-BFGS-B")
    return np.asarray(found.x)


def foretold(evidence: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the scores of motions by other weights than those of the code."""
    return 1.0 / (1.0 + np.exp(-evidence[:, :-1] @ weights)) / (1.0 + evidence[:, -1])


def summarize(folder: Path) -> None:
    """Fit to all cells of a folder, and print the weights and the reliability table."""
    files = sorted(folder.glob("*.npz"))
    cells = [np.load(file) for file in files]
    kinds = np.concatenate(
        [[f.stem[:-2]] * len(c["right"]) for f, c in zip(files, cells, strict=True)]
    )
    evidence = np.concatenate([cell["evidence"] for cell in cells])
    right = np.concatenate([cell["right"] for cell in cells])
    print(f"{len(right)} motions of {len(files)} worlds, {np.mean(right):.0%} of them right")
    for name, weight in zip(confidence.EVIDENCE, fit(evidence, right), strict=True):
        print(f"{weight:8.2f}  {name}")
    scores = np.zeros(len(right))
    for kind in np.unique(kinds):
        own = kinds == kind
        scores[own] = foretold(evidence[own], fit(evidence[~own], right[~own]))
    places = np.minimum((CALIBRATION_BINS * scores).astype(int), CALIBRATION_BINS - 1)
    error = sum(
        abs(float(np.sum(scores[places == place] - right[places == place])))
        for place in range(CALIBRATION_BINS)
    )
    print(f"expected calibration error {error / len(right):.4f}")
    print("| score | motions | foretold right | right | wrong |\n|---|---|---|---|---|")
    for low, high in pairwise(BINS):
        inside = (scores >= low) & (scores <= high if high == 1.0 else scores < high)
        if inside.any():
            shares = f"{np.mean(scores[inside]):.1%} | {np.mean(right[inside]):.1%}"
            wrong = np.count_nonzero(inside & ~right)
            print(f"| {low} to {high} | {np.count_nonzero(inside)} | {shares} | {wrong} |")


def main() -> None:
    """Measure the cells that are missing, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--shard", default="0/1", help="I/N: every N-th cell, from the I-th on")
    parser.add_argument("--limit", type=int, help="run this many cells at most")
    parser.add_argument("--summary", action="store_true", help="print what is there, run none")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    shard, shards = map(int, arguments.shard.split("/"))
    cells = [(kind, variant) for variant in range(len(VARIANTS)) for kind in floors.FLOORS]
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [c for c in cells[shard::shards] if not (folder / f"{c[0]}_{c[1]}.npz").exists()]
    for kind, variant in [] if arguments.summary else wanted[: arguments.limit]:
        evidence, right, trial = motions(kind, variant)
        print(f"{kind} {variant}: {len(right)} motions, {right.mean():.0%} right", flush=True)
        file = folder / f"{kind}_{variant}.npz"
        np.savez_compressed(file, evidence=evidence, right=right, trial=trial)
    summarize(folder)


if __name__ == "__main__":
    main()
