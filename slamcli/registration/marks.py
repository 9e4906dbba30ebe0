"""Marks on a floor that repeats: which motion of two views they support.

A mark is where a view differs from itself one period on. The other view shows it where the right
motion puts it, and where a motion that is one period off puts it, plain floor: marks support a
motion, or one beside a rival, though nearly all other pixels fit both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import invert
from slamcli.core.records import PreparedFrame
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.stages import dense

# Marks by which a view differs from itself, one period on, that a fit must explain to be supported
# [guarded by benchmarks/tiles.py: 0.45 m].
_MIN_MARKS_OF_A_VIEW = 3
# The multiple of the marks that a fit leaves unexplained that it must explain
# [benchmarks/tiles.py, 0.30 and 0.45 m: right motions 3:1 to 21:0, those one tile off 0:18 to 2:2].
_MIN_MARKS_RATIO = 3.0
# Likewise where nothing else supports it [benchmarks/tiles.py, 0.45 m: a false loop has 4:1].
_MIN_MARKS_ALONE = 6
_MIN_MARKS_RATIO_ALONE = 8.0
# Marks that a fit must explain to rule out a rival, and their multiple of those that the rival
# explains [benchmarks/tiles.py, 0.45 m and 3 marks: right motions 2:0 to 27:0, those one tile off
# 0:11 to 4:8; without marks no motion explains more than one].
_MIN_MARKS_BESIDE_RIVAL = 6
_MIN_RATIO_BESIDE_RIVAL = 4.0


@dataclass(frozen=True, slots=True)
class MarkCount:
    """The number of marks that a motion explains and leaves unexplained."""

    explained: int
    unexplained: int

    def supports(self, least: int, ratio: float) -> bool:
        """Return whether enough marks are explained, and many times those that are not."""
        return self.explained >= max(least, ratio * self.unexplained)


def is_unmistakable(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    fit: MotionHypothesis,
    calibration: Calibration,
) -> bool:
    """Return whether a floor does not repeat, or its marks alone are where a motion puts them.

    Required where nothing is known of where a frame lies: any other place that looks the same may
    be what it shows.

    Parameters
    ----------
    keyframe, prepared : PreparedFrame
    fit : MotionHypothesis
    calibration : Calibration
    """
    periods = keyframe.repeats, prepared.repeats
    if not any(len(shifts) for shifts in periods):
        return True
    pair = PyramidPair(keyframe.levels, prepared.levels)
    return RepeatMarks(pair, *periods, calibration).support(fit, alone=True)


class RepeatMarks:
    """The marks of two views by which each differs from itself; found when first needed.

    Parameters
    ----------
    pair : PyramidPair
    periods_a, periods_b : (K, 2) float64
        Shifts, metres in each robot's axes, by which the views look like themselves.
    calibration : Calibration
    """

    def __init__(
        self,
        pair: PyramidPair,
        periods_a: Float64Array,
        periods_b: Float64Array,
        calibration: Calibration,
    ) -> None:
        self._pair = pair
        self._marks_a, self._marks_b = (
            Deferred(partial(dense.own_marks, levels, periods, calibration))
            for levels, periods in ((pair.a, periods_a), (pair.b, periods_b))
        )

    def count(self, fit: MotionHypothesis) -> MarkCount:
        """Return how many marks of both views a motion explains."""
        explained = unexplained = 0
        a_from_b, a, b = fit.view_a_from_view_b, self._pair.a[0], self._pair.b[0]
        for first, second, motion, marks in (
            (a, b, a_from_b, self._marks_a.value),
            (b, a, invert(a_from_b), self._marks_b.value),
        ):
            if marks.any():
                pro, contra = dense.count_explained(first, second, motion, marks)
                explained, unexplained = explained + pro, unexplained + contra
        return MarkCount(explained, unexplained)

    def support(self, fit: MotionHypothesis, *, alone: bool = False) -> bool:
        """Return whether the marks are where a motion puts them; not so where there are too few.

        Parameters
        ----------
        fit : MotionHypothesis
        alone : bool
            Whether nothing else supports it: any other place of the floor may have such marks.
        """
        if alone:
            return self.count(fit).supports(_MIN_MARKS_ALONE, _MIN_MARKS_RATIO_ALONE)
        return self.count(fit).supports(_MIN_MARKS_OF_A_VIEW, _MIN_MARKS_RATIO)

    def rule_out(self, rival: MotionHypothesis, fit: MotionHypothesis) -> bool:
        """Return whether many marks are where a fit puts them, and few where its rival does."""
        by_fit = self.count(fit)
        if not by_fit.supports(_MIN_MARKS_BESIDE_RIVAL, _MIN_MARKS_RATIO):
            return False
        by_rival = self.count(rival)
        # A rival under which no mark is seen again is not contradicted by any.
        return (
            by_fit.explained >= _MIN_RATIO_BESIDE_RIVAL * by_rival.explained
            and by_rival.unexplained > by_rival.explained
        )
