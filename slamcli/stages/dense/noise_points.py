"""Points of a template that show only noise: on plain floors most of them do.

Noise has gradients too. Beside a few lines on a plain floor its points are many and lie far apart:
in the normal equations of a turn about the lines they outweigh the lines' own, so that every step
is much too short and the motion looks less certain than it is. What both views show has the same
gradients in both; the noise of two views has not.
"""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.records import PyramidLevel, SampledLevel, Template
from slamcli.stages.dense import sparse_view
from slamcli.stages.dense.covariance import FitState
from slamcli.stages.dense.photometric_residuals import (
    MIN_TEMPLATE_PIXELS,
    LevelResiduals,
    WarpModel,
    sampled,
)

# The weaker half of a texture's points carries a fifth to two fifths of the squared gradients, that
# of a few lines on a plain floor next to nothing [guarded by benchmarks/courses.py].
_MAX_SHARE_OF_WEAKER_HALF = 0.1
# What is left out may carry this share of the squared gradients that both views show: with a
# larger one the feet of edges are among it [guarded by tests/stages/test_noise_points.py].
_MAX_LOST_SHARE = 0.02
# It is noise when its gradients correlate by less than the first between the views, while those of
# what is kept correlate by more than the second [guarded by benchmarks/courses.py].
_MAX_CORRELATION_OF_NOISE = 0.5
_MIN_CORRELATION_OF_FLOOR = 0.5
# Points by which that is found where few are to be enough.
_SPARSE_POINTS = 1500


def without_noise(
    a: PyramidLevel,
    b: PyramidLevel | SampledLevel,
    model: WarpModel,
    state: FitState,
    *,
    sparse: bool = False,
) -> PyramidLevel:
    """Return view a's level without its weak points, where both views show only noise in them.

    Parameters
    ----------
    a : PyramidLevel
    b : PyramidLevel or SampledLevel
    model : WarpModel
    state : FitState
        Where the strong points of the two levels overlap already.
    sparse : bool
        Whether fewer points are to be enough for that.
    """
    some = sampled(a, _SPARSE_POINTS) if sparse else sampled(a)
    least = _least_strength(some, b, model, state)
    return a if least is None else a.part(_strength(a.template.value) >= least)


def _strength(template: Template) -> Float64Array:
    """Return the (N,) squared gradients of a template's points."""
    strength: Float64Array = (template.slopes[:2] ** 2).sum(axis=0)
    return strength


def _least_strength(
    a: PyramidLevel, b: PyramidLevel | SampledLevel, model: WarpModel, state: FitState
) -> float | None:
    """Return the squared gradient below which points show only noise; None where none do."""
    strength = _strength(a.template.value)
    middle = len(strength) // 2
    weaker_half = np.partition(strength, middle)[:middle]
    if weaker_half.sum() > _MAX_SHARE_OF_WEAKER_HALF * strength.sum():
        return None
    linear = LevelResiduals.of(a, b, model).linearise(state)
    if linear is None:
        return None
    in_b = -np.stack(sparse_view.slopes_at(b, linear.places))
    shared = (linear.slopes[:2] * in_b).sum(axis=0)
    shown = strength[linear.places.chosen]
    order = np.argsort(shown, kind="stable")
    carried = np.maximum.accumulate(np.cumsum(shared[order]))
    count = int(np.searchsorted(carried, _MAX_LOST_SHARE * shared.sum()))
    count = min(count, len(order) - 2 * MIN_TEMPLATE_PIXELS)
    if count <= 0:
        return None
    weak, kept = order[:count], order[count:]
    if _ratio(shared[weak], shown[weak]) >= _MAX_CORRELATION_OF_NOISE:
        return None
    if _ratio(shared[kept], shown[kept]) < _MIN_CORRELATION_OF_FLOOR:
        return None
    return float(shown[kept[0]])


def _ratio(shared: Float64Array, shown: Float64Array) -> float:
    return float(shared.sum() / max(float(shown.sum()), 1e-12))
