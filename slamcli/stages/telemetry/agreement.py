"""Comparison of odometry with what the frames show: units, handedness, mounting and clock.

Motions between frames are compared with those of the readings as they are, and as they would be in
other units, another frame of reference or another clock. Readings that contradict the frames are
named by the simplest of these changes that removes the contradiction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array
from slamcli.core.geometry import Pose2, relative_poses
from slamcli.stages.telemetry.odometry import sample

# Motions of at least one of these lengths are compared, so that what adds up slowly shows too:
# metres and radians [guarded by tests/stages/test_agreement.py].
_LEVELS = ((0.02, math.radians(3.0)), (0.1, math.radians(10.0)), (0.5, math.radians(30.0)))
# A motion contradicts when it differs by more than this share and these amounts: far more than
# wheels slip [guarded by tests/stages/test_agreement.py].
_MAX_SHARE = 0.3
_MAX_METRES = 0.003
_MAX_RADIANS = math.radians(2.0)
# So many motions, and this share of them, must contradict. An explanation must remove nearly all
# contradictions; where there is one, a smaller share is enough.
_MIN_CONTRADICTING = 4
_MIN_SHARE, _MIN_EXPLAINED_SHARE, _MAX_LEFT_SHARE = 0.5, 0.15, 0.2
# Offsets of the clock that are tried, seconds.
_MAX_OFFSET_SECONDS, _OFFSET_STEP_SECONDS = 2.0, 0.05
# Turns that are compared with a compass, and by how much it errs, iron nearby included.
_COMPASS_TURN_RADIANS = math.radians(20.0)
_MAX_COMPASS_RADIANS = math.radians(12.0)
# Lengths within this ratio of a unit are in it.
_UNIT_RATIO = 1.15
_UNITS = {
    1e-3: "in millimetres, not metres",
    1e-2: "in centimetres, not metres",
    0.0254: "in inches, not metres",
    0.3048: "in feet, not metres",
    1e3: "in kilometres, not metres",
}

Poses = Float64Array
Change = Callable[[Poses], Poses]


class VisualMotions:
    """The motions that pictures determined, composed into tracks: one for each run of frames."""

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}
        self._stamps: list[float] = []
        self._poses: list[Pose2] = []
        self._tracks: list[int] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, first: tuple[int, float], second: tuple[int, float], motion: Pose2) -> None:
        """Add the motion between two frames, each an index and a stamp (s)."""
        if first[0] not in self._rows:
            self._append(first, Pose2(), len(self._stamps))
        if second[0] not in self._rows:
            row = self._rows[first[0]]
            self._append(second, self._poses[row] @ motion, self._tracks[row])

    def _append(self, frame: tuple[int, float], pose: Pose2, track: int) -> None:
        self._rows[frame[0]] = len(self._stamps)
        self._stamps.append(frame[1])
        self._poses.append(pose)
        self._tracks.append(track)

    def arrays(self) -> tuple[Float64Array, Poses, Int64Array]:
        """Return (M,) stamps, (M, 3) poses and (M,) tracks, by track and stamp."""
        stamps, tracks = np.array(self._stamps, float), np.array(self._tracks, np.int64)
        poses = np.array([(p.x, p.y, p.theta) for p in self._poses], float).reshape(-1, 3)
        order = np.lexsort((stamps, tracks))
        return stamps[order], poses[order], tracks[order]


@dataclass(frozen=True, slots=True, eq=False)
class _Motions:
    """Motions between pairs of frames.

    Attributes
    ----------
    begin, end : (K,) float64
        Stamps.
    seen : (K, 3) float64
    lengths : (K,) float64
        Of the path from one frame to the other.
    """

    begin: Float64Array
    end: Float64Array
    seen: Poses
    lengths: Float64Array


def find_fault(
    stamps: Float64Array,
    poses: Poses,
    tracks: Int64Array,
    visual: VisualMotions,
    given_seconds: float = 0.0,
) -> str:
    """Return in which way odometry contradicts the frames, as a sentence with advice.

    Parameters
    ----------
    stamps : (N,) float64
        In the frames' clock, ascending.
    poses : (N, 3) float64
    tracks : (N,) int64
        Readings of different numbers do not belong together: the odometry was reset.
    visual : VisualMotions
    given_seconds : float
        The offset of the clock that the stamps have already.

    Returns
    -------
    str, empty when there is no contradiction, or too little to compare.
    """
    moments, seen, pieces = visual.arrays()
    if len(stamps) < 2 or len(moments) < _MIN_CONTRADICTING:
        return ""
    if stamps[-1] < moments.min() or stamps[0] > moments.max():
        ends = (float(moments.min()), float(moments.max()))
        return clocks_apart((float(stamps[0]), float(stamps[-1])), ends, given_seconds)
    for level in _LEVELS:
        motions = _motions(moments, seen, pieces, level)
        if motions is not None:
            fault = _fault_of(_Readings(stamps, poses, tracks, given_seconds), motions)
            if fault:
                return fault
    return ""


def find_heading_fault(stamps: Float64Array, headings: Float64Array, visual: VisualMotions) -> str:
    """Return in which way a compass contradicts the frames, as a sentence with advice.

    Parameters
    ----------
    stamps : (N,) float64
        In the frames' clock, ascending.
    headings : (N,) float64
    visual : VisualMotions

    Returns
    -------
    str, empty when there is no contradiction that another unit or direction explains.
    """
    moments, seen, pieces = visual.arrays()
    motions = _motions(moments, seen, pieces, (math.inf, _COMPASS_TURN_RADIANS))
    if len(stamps) < 2 or motions is None:
        return ""
    poses = np.column_stack([np.zeros((len(headings), 2)), headings])
    readings = _Readings(stamps, poses, np.zeros(len(stamps), np.int64))
    count = 0
    for change, text in _COMPASSES:
        measured, covered = readings.motions(motions, change, 0.0)
        turn = _turn_between(measured, motions.seen)[covered]
        seen_turn = np.abs(motions.seen[covered, 2])
        wrong = int((turn > _MAX_SHARE * seen_turn + _MAX_COMPASS_RADIANS).sum())
        if not text:
            count = wrong
            if count < max(_MIN_CONTRADICTING, _MIN_SHARE * covered.sum()):
                return ""
        elif wrong <= count // 3:
            return f"contradicts the frames: {text}"
    return ""


def clocks_apart(
    readings: tuple[float, float], frames: tuple[float, float], given_seconds: float
) -> str:
    """Return the fault of readings of another time than the frames, by their first and last."""
    offset = frames[0] - readings[0] + given_seconds
    return (
        f"covers {readings[0]:.3f} to {readings[1]:.3f} s and the frames {frames[0]:.3f} to "
        f"{frames[1]:.3f} s: their clocks differ; if both began together give --time-offset "
        f"{offset:.3f}"
    )


def _motions(
    moments: Float64Array, seen: Poses, pieces: Int64Array, level: tuple[float, float]
) -> _Motions | None:
    """Return motions that follow one another, each of at least a length or a turn."""
    pairs = []
    first = 0
    for second in range(1, len(moments)):
        if pieces[second] != pieces[first]:
            first = second
            continue
        x, y, turn = relative_poses(seen[first], seen[second])
        if math.hypot(x, y) >= level[0] or abs(turn) >= level[1]:
            pairs.append((first, second))
            first = second
    if not pairs:
        return None
    a, b = np.array(pairs).T
    path = np.append(0.0, np.cumsum(np.hypot(*np.diff(seen[:, :2], axis=0).T)))
    return _Motions(moments[a], moments[b], relative_poses(seen[a], seen[b]), path[b] - path[a])


@dataclass(frozen=True, slots=True, eq=False)
class _Readings:
    """The readings of odometry: (N,) stamps with a given offset, (N, 3) poses, (N,) tracks."""

    stamps: Float64Array
    poses: Poses
    tracks: Int64Array
    given_seconds: float = 0.0

    def motions(self, wanted: _Motions, change: Change, offset: float) -> tuple[Poses, BoolArray]:
        """Return (K, 3) motions of the readings after a change, and which ones they cover."""
        ends = [wanted.begin - offset, wanted.end - offset]
        sampled = [sample(self.stamps, change(self.poses), moments) for moments in ends]
        covered = (ends[0] >= self.stamps[0]) & (ends[1] <= self.stamps[-1])
        after = [np.searchsorted(self.stamps, moments) for moments in ends]
        last = len(self.stamps) - 1
        tracks = [self.tracks[np.clip([n - 1, n], 0, last)] for n in after]
        covered &= np.ptp(np.concatenate(tracks), axis=0) == 0
        return relative_poses(*sampled), covered


def _fault_of(readings: _Readings, motions: _Motions) -> str:
    """Return how motions contradict the readings, by the simplest explanation; empty if not."""
    measured, covered = readings.motions(motions, _same, 0.0)
    wrong = _contradicting(measured, motions) & covered
    count, total = int(wrong.sum()), int(covered.sum())
    if count < _MIN_CONTRADICTING or count < _MIN_EXPLAINED_SHARE * total:
        return ""
    for change, offset, text in _explanations(readings, motions):
        measured, still_covered = readings.motions(motions, change, offset)
        left = int((_contradicting(measured, motions) & still_covered).sum())
        compared = int(still_covered.sum())
        enough = compared >= max(_MIN_CONTRADICTING, total // 2)
        if enough and left <= min(_MAX_LEFT_SHARE * compared, count // 3):
            return text
    if count < _MIN_SHARE * total:
        return ""
    return (
        f"contradicts the frames in {count} of {total} motions, and no other unit, axis or clock "
        "explains it: leave it out, or check it and the calibration"
    )


def _contradicting(measured: Poses, motions: _Motions) -> BoolArray:
    """Return which of (K, 3) motions differ by more than wheels slip."""
    apart = np.hypot(*(measured - motions.seen)[:, :2].T)
    turn = _turn_between(measured, motions.seen)
    far = apart > _MAX_SHARE * motions.lengths + _MAX_METRES
    turned = turn > _MAX_SHARE * np.abs(motions.seen[:, 2]) + _MAX_RADIANS
    return np.asarray(far | turned)


def _turn_between(measured: Poses, seen: Poses) -> Float64Array:
    return np.asarray(np.abs((measured[:, 2] - seen[:, 2] + np.pi) % (2.0 * np.pi) - np.pi))


def _same(poses: Poses) -> Poses:
    return poses


def _in_degrees(poses: Poses) -> Poses:
    # Poses keep headings within a turn of 2 pi, of whatever unit.
    return np.column_stack([poses[:, :2], np.radians(np.unwrap(poses[:, 2]))])


def _plain_degrees(poses: Poses) -> Poses:
    return poses * (1.0, 1.0, math.pi / 180.0)


def _clockwise(poses: Poses) -> Poses:
    return poses * (1.0, 1.0, -1.0)


def _right(poses: Poses) -> Poses:
    return poses * (1.0, -1.0, 1.0)


def _left_handed(poses: Poses) -> Poses:
    return poses * (1.0, -1.0, -1.0)


def _bearing(poses: Poses) -> Poses:
    return poses * (1.0, 1.0, -1.0) + (0.0, 0.0, math.pi / 2)


def _turned(degrees: float) -> Change:
    turn = np.array([0.0, 0.0, math.radians(degrees)])
    return lambda poses: poses + turn


_UNITS_OF_ANGLE: tuple[tuple[Change, str], ...] = (
    (_same, ""),
    (_in_degrees, "its headings are in degrees, not radians"),
)
_HANDS: tuple[tuple[Change, str], ...] = (
    (_same, ""),
    (_left_handed, "its y axis and headings are left-handed: negate both"),
    (_clockwise, "its headings are left-handed, clockwise: negate them"),
    (_right, "its y axis is left-handed, to the right: negate y"),
    (_bearing, "its headings are clockwise from north: take 90 degrees minus them"),
    *(
        (_turned(angle), f"its x axis is turned by {-angle} degrees from where the camera looks")
        for angle in (90, -90, 180)
    ),
)


_COMPASSES: tuple[tuple[Change, str], ...] = (
    (_same, ""),
    (_plain_degrees, "its headings are in degrees, not radians"),
    (_clockwise, "its headings are clockwise: name the column bearing"),
    (
        lambda poses: _clockwise(_plain_degrees(poses)),
        "its headings are clockwise and in degrees: name the column bearing_degrees",
    ),
)


def _explanations(readings: _Readings, motions: _Motions) -> Iterator[tuple[Change, float, str]]:
    """Yield changes of the readings, their clock's offset and what they mean; simple ones first."""
    found = []
    for angle, angle_text in _UNITS_OF_ANGLE:
        for hand, hand_text in _HANDS:
            for scale, scale_text in [(1.0, ""), *_scale(readings, motions)]:
                texts = [text for text in (angle_text, hand_text, scale_text) if text]
                change = _chain(angle, hand, scale)
                if angle is _in_degrees:
                    change = _chain(change, _turned(_direction(readings, motions, change)), 1.0)
                found.append((change, texts))
    found.sort(key=lambda explanation: len(explanation[1]))
    for change, texts in found:
        if len(texts) == 1:
            yield change, 0.0, f"contradicts the frames: {texts[0]}"
    for offset in _offsets(readings, motions):
        text = (
            f"contradicts the frames: its clock differs; give --time-offset "
            f"{offset + readings.given_seconds:.2f}, or --time-offset auto"
        )
        yield _same, offset, text
    for change, texts in found:
        if len(texts) > 1:
            yield change, 0.0, f"contradicts the frames: {'; '.join(texts)}"


def _chain(angle: Change, hand: Change, scale: float) -> Change:
    return lambda poses: hand(angle(poses)) * (scale, scale, 1.0)


def _direction(readings: _Readings, motions: _Motions, change: Change) -> float:
    """Return the degrees by which headings must be turned for the motions to lie as they do."""
    measured, covered = readings.motions(motions, change, 0.0)
    here, there = ((poses[covered, :2] @ (1.0, 1j)) for poses in (measured, motions.seen))
    return math.degrees(-float(np.angle(np.vdot(here, there))))


def _scale(readings: _Readings, motions: _Motions) -> list[tuple[float, str]]:
    """Return the factor by which the readings' lengths become those of the frames."""
    measured, covered = readings.motions(motions, _same, 0.0)
    lengths, seen = (np.hypot(*poses[covered, :2].T) for poses in (measured, motions.seen))
    moving = (lengths > 0.0) & (seen > _MAX_METRES)
    if not moving.any():
        return []
    factor = float(np.median(seen[moving] / lengths[moving]))
    for unit, text in _UNITS.items():
        if unit / _UNIT_RATIO < factor < unit * _UNIT_RATIO:
            return [(unit, f"its lengths are {text}")]
    if 1.0 / (1.0 + _MAX_SHARE) < factor < 1.0 + _MAX_SHARE:
        return []
    text = (
        f"its lengths are {1.0 / factor:.3g} times those of the frames: check the wheels' radius, "
        "and the side given to slam calibrate"
    )
    return [(factor, text)]


def _offsets(readings: _Readings, motions: _Motions) -> Iterator[float]:
    """Yield the offset of the clocks at which the fewest motions contradict, the middle of such."""
    count = round(_MAX_OFFSET_SECONDS / _OFFSET_STEP_SECONDS)
    grid = _OFFSET_STEP_SECONDS * np.arange(-count, count + 1)
    shares = []
    for offset in grid:
        measured, covered = readings.motions(motions, _same, float(offset))
        enough = covered.sum() >= max(_MIN_CONTRADICTING, len(covered) // 2)
        wrong = _contradicting(measured, motions)[covered]
        shares.append(float(wrong.mean()) if enough else 1.0)
    best = np.flatnonzero(np.array(shares) == min(shares))
    yield float(grid[best[len(best) // 2]])
