"""The matches of all pairs of frames, as the bundle adjustment observes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.robust import NORMAL_MEDIAN, RAYLEIGH_MEDIAN
from slamcli.stages.adjustment.frame_poses import FramePose, MountedFrames
from slamcli.stages.adjustment.patch_tracking import Matches
from slamcli.stages.adjustment.projection import Transfer, product, transfer_with_jacobians

# A match whose one direction is known this much worse than the other lies on a line
# [guarded by benchmarks/self_calibration.py].
_LINE_RATIO = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The matches of all pairs of frames in one table, pair after pair.

    Attributes
    ----------
    pairs : (P, 2) int64
        Positions of each pair's frames among the layout's.
    pair : (M,) int64
        Which pair each match is of, ascending.
    pixels_a, pixels_b : (M, 2), (2, M) float64
        In the frames' own images.
    whitening : (2, 2, M) float64
        Turns an error of `pixels_b` into standard deviations.
    median : (M,) float64
        Of the length of a residual, were it a standard normal one.
    """

    pairs: Int64Array
    pair: Int64Array
    pixels_a: Float64Array
    pixels_b: Float64Array
    whitening: Float64Array
    median: Float64Array

    @classmethod
    def of(cls, matches: Sequence[Matches], frames: Sequence[int]) -> Observations:
        """Return the table of pairs of the given frames."""
        positions = {index: position for position, index in enumerate(frames)}
        whitening = np.concatenate([pair.whitening for pair in matches])
        precision = np.linalg.norm(whitening, axis=2)
        line = precision.min(axis=1) < _LINE_RATIO * precision.max(axis=1)
        return cls(
            np.array([(positions[pair.a], positions[pair.b]) for pair in matches], np.int64),
            np.repeat(np.arange(len(matches)), [len(pair) for pair in matches]),
            np.concatenate([pair.pixels_a for pair in matches]),
            np.concatenate([pair.pixels_b for pair in matches]).T,
            np.ascontiguousarray(whitening.transpose(1, 2, 0)),
            np.where(line, NORMAL_MEDIAN, RAYLEIGH_MEDIAN),
        )

    def transfer(self, calibration: Calibration, poses: Sequence[FramePose]) -> Transfer:
        """Return where every match is seen in its pair's second frame, given all frames' poses."""
        frames = MountedFrames.of(calibration, poses)
        a, b = self.pairs[self.pair].T
        return transfer_with_jacobians(calibration, frames.take(a), frames.take(b), self.pixels_a)

    def whitened(self, errors: Float64Array) -> Float64Array:
        """Return errors (2, M) of `pixels_b` in standard deviations."""
        return product(self.whitening, errors[:, None])[:, 0]


def residual_lengths(
    calibration: Calibration, poses: Mapping[int, FramePose], matches: Sequence[Matches]
) -> Float64Array:
    """Return the length of every match's residual, in its own sigmas, all pairs in their order."""
    if not matches:
        return np.zeros(0)
    frames = sorted({index for pair in matches for index in (pair.a, pair.b)})
    observations = Observations.of(matches, frames)
    moved = observations.transfer(calibration, [poses[index] for index in frames])
    residual = observations.whitened(moved.pixels - observations.pixels_b)
    return np.asarray(np.linalg.norm(residual, axis=0))
