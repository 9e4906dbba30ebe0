"""Hostile frames and readings: what a bug may pass to `Mapper.update` or `Locator.locate`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.core.telemetry import CompassReading, GpsReading, OdometryReading

SIZE = (240, 320)
INDICES: tuple[Any, ...] = (
    math.nan,
    math.inf,
    -1,
    1.5,
    "1",
    None,
    2**31,
    10**30,
    True,
    [1],
    (1, 2),
)
STAMPS: tuple[Any, ...] = (math.nan, math.inf, "1", 1e300, -1e18, 10**400, True, [1], b"")
NUMBERS = (0.0, -1.0, 1e-300, 1e-18, 1e18, 1e300, math.nan, math.inf, -math.inf, 1e6, 90.0, 180.0)


def images(rng: np.random.Generator) -> list[Callable[[], Any]]:
    """Return makers of things given as pixels."""
    height, width = SIZE
    noise = rng.integers(0, 256, (*SIZE, 3), np.uint8)
    return [
        lambda: None,
        lambda: "frame.png",
        lambda: [[1, 2], [3, 4]],
        lambda: np.float64(3.0),
        lambda: np.zeros((0, 0), np.uint8),
        lambda: np.zeros((height, 0, 3), np.uint8),
        lambda: np.zeros((1, 1), np.uint8),
        lambda: np.zeros((height, width, 4), np.uint8),
        lambda: np.zeros((height, width, 3, 1), np.uint8),
        lambda: noise.astype(np.float32),
        lambda: np.full(SIZE, np.nan),
        lambda: noise.astype(np.int64),
        lambda: noise[..., 0] > 128,
        lambda: noise.astype(object),
        lambda: np.array(["x"] * 4),
        lambda: noise.astype(np.uint8)[::-1, ::-1],
        lambda: np.asfortranarray(noise),
        lambda: np.broadcast_to(np.uint8(7), (height, width, 3)),
        lambda: np.broadcast_to(np.uint8(7), (30_000, 30_000)),
        lambda: np.broadcast_to(np.uint8(7), (2**31, 2**31)),
        lambda: np.ma.masked_array(noise, noise > 9),
        lambda: noise[..., 0].view(np.matrix),
        lambda: read_only(noise),
        lambda: noise[:, ::2],
        lambda: np.zeros((*SIZE, 3), np.uint8),
        lambda: np.full(SIZE, 255, np.uint8),
        lambda: noise,
        lambda: rng.integers(0, 256, SIZE, np.uint8),
        lambda: np.zeros(SIZE, [("a", "u1")]),
    ]


def read_only(array: np.ndarray) -> np.ndarray:
    copy = array.copy()
    copy.setflags(write=False)
    return copy


def masks(rng: np.random.Generator) -> list[Any]:
    """Return things given as a mask."""
    return [
        None,
        "mask",
        np.zeros((0, 0), np.uint8),
        np.zeros(SIZE, np.uint8),
        np.full(SIZE, 255, np.uint8),
        np.full(SIZE, 7, np.uint8),
        np.ones(SIZE, np.bool_),
        np.full(SIZE, np.nan),
        np.zeros((*SIZE, 3), np.uint8),
        np.zeros((5, 5), np.uint8),
        np.ma.masked_all(SIZE, np.uint8),
        rng.integers(0, 256, SIZE, np.uint8)[::-1],
        3,
    ]


def frame(rng: np.random.Generator, good: np.ndarray, index: int) -> Any:
    """Return one hostile frame: no frame at all, or some of its fields wrong."""
    makers = images(rng)
    image = makers[rng.integers(len(makers))]() if rng.random() < 0.6 else good
    if rng.random() < 0.3:
        return image
    if rng.random() < 0.1:
        return [Frame, None, 7, b"", {}, Frame(index, "x", None, good).__class__][rng.integers(6)]
    return Frame(
        INDICES[rng.integers(len(INDICES))] if rng.random() < 0.2 else index,
        [None, 5, "", "a\ud800", "\0", "n" * 10_000][rng.integers(6)]
        if rng.random() < 0.2
        else f"frame {index}",
        STAMPS[rng.integers(len(STAMPS))] if rng.random() < 0.2 else float(index),
        image,
        masks(rng)[rng.integers(13)] if rng.random() < 0.4 else None,
    )


def reading(rng: np.random.Generator, stamp: float) -> Any:
    """Return a reading with hostile numbers; None where its class refuses to be made of them."""

    def number(usual: float) -> float:
        return float(NUMBERS[rng.integers(len(NUMBERS))]) if rng.random() < 0.3 else usual

    at = number(stamp)
    try:
        kind = rng.integers(3)
        if kind == 0:
            pose = Pose2(number(stamp / 10), number(0.0), number(0.1))
            return OdometryReading(at, pose)
        if kind == 1:
            return CompassReading(at, number(0.3), number(0.05))
        return GpsReading(at, number(29.6), number(-82.3), number(1.0))
    except (InputError, ValueError):
        return None


def expectation(rng: np.random.Generator) -> tuple[Any, Any]:
    """Return what may be given as an expected pose, and as its sigmas."""

    def number(usual: float) -> float:
        return float(NUMBERS[rng.integers(len(NUMBERS))]) if rng.random() < 0.2 else usual

    pose: Any = None
    if rng.random() < 0.8:
        pose = Pose2(number(0.02), number(0.0), number(0.0))
    elif rng.random() < 0.5:
        pose = ["x", 3, np.eye(3), (1, 2, 3), b""][rng.integers(5)]
    sigma: Any = (number(0.1), number(0.1))
    if rng.random() < 0.1:
        sigma = [None, "x", (1,), (0, 0), [1, 2, 3], math.nan, ("1", "2")][rng.integers(7)]
    return pose, sigma
