"""Interfaces of trained networks, for the stages that never see their files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from slamcli.core.arrays import Float32Array, Float64Array, Int32Array, UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class NetworkPoints:
    """Result of a point network on a picture of its own size.

    Attributes
    ----------
    pixels : (N, 2) float64
        Column and row.
    scores : (N,) float32
    descriptors : (N, D) float32
    """

    pixels: Float64Array
    scores: Float32Array
    descriptors: Float32Array


class PointNetwork(Protocol):
    """A network that finds and describes points; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures that it takes, pixels."""

    def find(self, image: UInt8Array) -> NetworkPoints:
        """Return the points of an (h, w, 3) BGR picture of its size; raises FrameError."""


class MatchNetwork(Protocol):
    """A network that pairs the points of two pictures."""

    def match(
        self,
        positions_a: Float32Array,
        positions_b: Float32Array,
        descriptors_a: Float32Array,
        descriptors_b: Float32Array,
    ) -> tuple[Int32Array, Float32Array]:
        """Return (M, 2) pairs of indices and (M,) distances; raises InputError.

        Parameters
        ----------
        positions_a, positions_b : (N, 2) float32
            Right and down, in [-1, 1] over what the two show.
        descriptors_a, descriptors_b : (N, D) float32

        Returns
        -------
        pairs : (M, 2) int32
        distances : (M,) float32
            One minus the network's confidence.
        """
