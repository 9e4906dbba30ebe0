"""The network of pairs: which frames they connect, and a first guess of every frame's state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey.lens import Lens
from slamcli.survey.pairs import Pair, fit_similarity
from slamcli.survey.projection import LOG_SCALE, STATES


def connected(pairs: Sequence[Pair], frames: int) -> list[list[int]]:
    """Return the sets of frames that pairs connect, the largest first, each in order."""
    parent = list(range(frames))

    def root(frame: int) -> int:
        while parent[frame] != frame:
            parent[frame] = parent[parent[frame]]
            frame = parent[frame]
        return frame

    for pair in pairs:
        first, second = sorted((root(pair.a), root(pair.b)))
        parent[second] = first
    members: dict[int, list[int]] = {}
    for frame in range(frames):
        members.setdefault(root(frame), []).append(frame)
    return sorted(members.values(), key=lambda found: (-len(found), found[0]))


def first_states(pairs: Sequence[Pair], frames: Sequence[int], lens: Lens) -> Float64Array:
    """Return (N, 6) states without tilt, chained from the first frame by the strongest pairs.

    The first frame is the map's origin; the scales' geometric mean is 1.
    """
    neighbours: dict[int, list[tuple[int, Float64Array]]] = {frame: [] for frame in frames}
    for pair in _spanning_tree(pairs):
        a, b, weights = _from_above(pair, lens)
        neighbours[pair.a].append((pair.b, fit_similarity(b, a, weights)))
        neighbours[pair.b].append((pair.a, fit_similarity(a, b, weights)))
    first_from = {frames[0]: np.eye(3)}
    left = [frames[0]]
    while left:
        frame = left.pop(0)
        for other, frame_from_other in neighbours[frame]:
            if other not in first_from:
                first_from[other] = first_from[frame] @ frame_from_other
                left.append(other)
    states = np.zeros((len(frames), STATES))
    for number, frame in enumerate(frames):
        matrix = first_from[frame]
        scale = math.hypot(matrix[0, 0], matrix[1, 0])
        # Rows of a picture run down, the map's y up.
        turn = -math.atan2(matrix[1, 0], matrix[0, 0])
        states[number, :4] = matrix[0, 2], -matrix[1, 2], turn, math.log(scale)
    return rescaled(states)


def _from_above(pair: Pair, lens: Lens) -> tuple[Float64Array, Float64Array, Float64Array | None]:
    """Return a pair's matches as a camera that looks straight down sees them, and their weights."""
    if lens.camera_from_nadir is None:
        return pair.pixels_a, pair.pixels_b, None
    nadir_from_camera = invert(lens.camera_from_nadir)
    both = pair.pixels_a, pair.pixels_b
    depths = [pixels @ nadir_from_camera[2, :2] + nadir_from_camera[2, 2] for pixels in both]
    a, b = (apply_homography(nadir_from_camera, pixels) for pixels in both)
    # An error of a pixel far away is one of much floor.
    return a, b, np.clip(np.minimum(*depths), 1e-3, None) ** 4


def rescaled(states: Float64Array) -> Float64Array:
    """Return states moved and scaled so that the first is the origin, the mean log scale 0."""
    scale = math.exp(-float(states[:, LOG_SCALE].mean()))
    place = (states[:, 0] - states[0, 0]) + 1j * (states[:, 1] - states[0, 1])
    place = scale * place * np.exp(-1j * states[0, 2])
    moved = states.copy()
    moved[:, 0], moved[:, 1] = place.real, place.imag
    moved[:, 2] -= states[0, 2]
    moved[:, LOG_SCALE] += math.log(scale)
    return moved


def _spanning_tree(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the strongest pairs that connect all frames without a loop."""
    strongest = sorted(pairs, key=lambda pair: (-pair.strength, pair.a, pair.b))
    component: dict[int, set[int]] = {}
    tree = []
    for pair in strongest:
        first = component.setdefault(pair.a, {pair.a})
        second = component.setdefault(pair.b, {pair.b})
        if first is not second:
            first |= second
            component.update(dict.fromkeys(second, first))
            tree.append(pair)
    return tree
