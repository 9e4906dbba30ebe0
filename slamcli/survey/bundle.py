"""Bundle adjustment of a survey: poses, tilts and heights of all frames, and their common lens.

Every match gives a transfer residual, in undistorted pixels of one of its frames: where the other
frame's point comes out through the plane, minus where it was seen. The robust least squares
(Cauchy's kernel) is solved by Levenberg and Marquardt's method on sparse normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from slamcli.core.arrays import BoolArray, Float64Array, IntpArray
from slamcli.core.robust import RAYLEIGH_MEDIAN
from slamcli.survey.lens import Lens, LensPrior, Mount
from slamcli.survey.pairs import Pair
from slamcli.survey.projection import LOG_SCALE, PITCH, STATES, undistort

# A pair counts for at most this many independent matches while the mount is learned: what errors
# they have, of relief and lens, they have in common [benchmarks/real_sets.py: with all 150 the tilt
# of seabeds is learned as 20 degrees]. With the mount known all of them count, for a sharper map.
CAUTIOUS_MATCHES, ALL_MATCHES = 10.0, 1e9
# So many of them are then used, but for the focal length: with all a survey takes half as long
# again.
_CAUTIOUS_KEPT = 50
# Cauchy's scale and the assumed noise, from the median residual, and their floors.
_KERNEL_SIGMAS, _MIN_KERNEL_PIXELS, _MIN_NOISE_PIXELS = 3.0, 1.0, 0.1
LensFree = Literal["none", "bend", "all"]
_ITERATIONS, _TRIALS, _CONVERGED_SHARE = 25, 8, 1e-5
_DAMPING, _MIN_DAMPING = 1e-4, 1e-9
_BEHIND_PIXELS = 1e4
_ANCHOR_INFORMATION = 1e8


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Result of an adjustment.

    Attributes
    ----------
    states : (N, 6) float64
        See `projection`; the first frame's pose is fixed.
    lens : Lens
    mount : Mount
    pair_pixels : (P,) float64
        Median residual of each pair.
    noise_pixels : float
    information : sparse (F, F)
        Of the free parameters, at the solution.
    free : (F,) int
        Which of all parameters they are.
    """

    states: Float64Array
    lens: Lens
    mount: Mount
    pair_pixels: Float64Array
    noise_pixels: float
    information: sparse.csc_array
    free: IntpArray


class _Matches:
    """The matches of all pairs as arrays: where each frame's points are transferred to."""

    def __init__(
        self,
        pairs: Sequence[Pair],
        number: dict[int, int],
        independent: float,
        most: int | None,
    ) -> None:
        kept = [_spread(len(pair.pixels_a), most) for pair in pairs]
        counts = np.array([len(some) for some in kept])
        self.pair = np.repeat(np.arange(len(pairs)), counts)
        a = np.repeat([number[pair.a] for pair in pairs], counts)
        b = np.repeat([number[pair.b] for pair in pairs], counts)
        pixels_a = np.concatenate([one.pixels_a[i] for one, i in zip(pairs, kept, strict=True)])
        pixels_b = np.concatenate([one.pixels_b[i] for one, i in zip(pairs, kept, strict=True)])
        # By turns in either direction: neither scale is preferred.
        turned = np.arange(len(a)) % 2 == 1
        self.source, self.target = np.where(turned, b, a), np.where(turned, a, b)
        self.seen = np.where(turned[:, None], pixels_b, pixels_a)
        self.expected = np.where(turned[:, None], pixels_a, pixels_b)
        self.weight = np.minimum(1.0, independent / counts)[self.pair]
        self.pairs = len(pairs)

    def __len__(self) -> int:
        return len(self.source)

    def residuals(self, states: Float64Array, lens: Lens) -> Float64Array:
        """Return (M, 2) pixels."""
        seen, _ = undistort(self.seen, lens.bend, lens.radius_pixels)
        expected, _ = undistort(self.expected, lens.bend, lens.radius_pixels)
        image_from_map = lens.project(states).image_from_map
        transfer = image_from_map[self.target] @ np.linalg.inv(image_from_map)[self.source]
        there = np.einsum("mij,mj->mi", transfer[:, :, :2], seen) + transfer[:, :, 2]
        in_front = there[:, 2] > 0.0
        residual = np.full_like(seen, _BEHIND_PIXELS)
        residual[in_front] = there[in_front, :2] / there[in_front, 2:] - expected[in_front]
        return residual

    def jacobian(self, states: Float64Array, lens: Lens) -> Float64Array:
        """Return (M, 2, 14): by the source's and the target's states, log focal length, bend."""
        seen, seen_by_bend = undistort(self.seen, lens.bend, lens.radius_pixels)
        _, expected_by_bend = undistort(self.expected, lens.bend, lens.radius_pixels)
        found = lens.project(states)
        map_from_image = np.linalg.inv(found.image_from_map)[self.source]
        floor = np.einsum("mij,mj->mi", map_from_image[:, :, :2], seen) + map_from_image[:, :, 2]
        there = np.einsum("mij,mj->mi", found.image_from_map[self.target], floor)
        by_there = np.zeros((len(self), 2, 3))
        by_there[:, 0, 0] = by_there[:, 1, 1] = 1.0 / there[:, 2]
        by_there[:, :, 2] = -there[:, :2] / there[:, 2:] ** 2
        by_seen = by_there @ found.image_from_map[self.target] @ map_from_image

        def through(chain: Float64Array, change: Float64Array) -> Float64Array:
            moved = np.einsum("mij,mj->mi", change, floor)
            return np.asarray(np.einsum("mij,mj->mi", chain, moved), np.float64)

        def by_states(chain: Float64Array, change: Float64Array) -> Float64Array:
            moved = np.einsum("mkij,mj->mki", change, floor)
            return np.asarray((chain @ moved.transpose(0, 2, 1)), np.float64)

        columns = np.empty((len(self), 2, 2 * STATES + 2))
        columns[:, :, :STATES] = -by_states(by_seen, found.by_state[self.source])
        columns[:, :, STATES:-2] = by_states(by_there, found.by_state[self.target])
        columns[:, :, -2] = through(by_there, found.by_log_focal[self.target])
        columns[:, :, -2] -= through(by_seen, found.by_log_focal[self.source])
        columns[:, :, -1] = np.einsum("mij,mj->mi", by_seen[:, :, :2], seen_by_bend)
        columns[:, :, -1] -= expected_by_bend
        return columns

    def columns(self, frames: int) -> IntpArray:
        """Return (M, 14): which parameter each column of the Jacobian is of."""
        own = np.arange(STATES)
        common = np.broadcast_to(STATES * frames + np.arange(2), (len(self), 2))
        of_source = STATES * self.source[:, None] + own
        return np.hstack([of_source, STATES * self.target[:, None] + own, common])

    def medians(self, residual: Float64Array) -> Float64Array:
        """Return (P,) pixels: the median of each pair."""
        lengths = np.linalg.norm(residual, axis=1)
        ends = np.flatnonzero(np.diff(self.pair)) + 1
        return np.array([float(np.median(part)) for part in np.split(lengths, ends)])


def _spread(count: int, most: int | None) -> IntpArray:
    """Return at most so many of the numbers below a count, evenly spread; None for all."""
    if most is None or count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).round().astype(np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Start of all parameters, and their Gaussian priors: means, and information."""

    frames: int
    start: Float64Array
    mean: Float64Array
    information: Float64Array


class _Solver:
    """Levenberg and Marquardt's iterations from a first guess."""

    def __init__(self, matches: _Matches, prior: _Prior, free: IntpArray, lens: Lens) -> None:
        self.matches, self.prior, self.free, self.lens = matches, prior, free, lens
        self.parameters = prior.start
        self.residual = self._residuals(prior.start)
        self.damping = _DAMPING
        columns = np.repeat(matches.columns(prior.frames)[:, None], 2, axis=1)
        rows = np.repeat(np.arange(2 * len(matches)), columns.shape[2])
        self._entries = rows, columns.ravel()
        self._set_scale()

    def run(self) -> None:
        """Iterate until the cost no longer falls."""
        for _ in range(_ITERATIONS):
            before = self._cost(self.parameters, self.residual)
            after = self._step(before)
            if before - after < _CONVERGED_SHARE * before:
                return
            self._set_scale()

    def unpacked(self, parameters: Float64Array) -> tuple[Float64Array, Lens]:
        """Return the states and the lens of all parameters."""
        focal, bend = float(np.exp(parameters[-2])), float(parameters[-1])
        lens = replace(self.lens, focal_pixels=focal, bend=bend)
        return parameters[:-2].reshape(-1, STATES), lens

    def normal_equations(self) -> tuple[sparse.csc_array, Float64Array]:
        """Return the information of the free parameters, and the gradient of the cost."""
        robust = 1.0 / (1.0 + np.sum(self.residual**2, axis=1) / self.kernel**2)
        root = np.sqrt(robust * self.matches.weight)[:, None] / self.noise
        values = self.matches.jacobian(*self.unpacked(self.parameters)) * root[:, :, None]
        shape = (2 * len(self.matches), len(self.parameters))
        jacobian = sparse.csr_array((values.ravel(), self._entries), shape=shape)[:, self.free]
        information = self.prior.information[self.free]
        normal = sparse.csc_array(jacobian.T @ jacobian + sparse.diags_array(information))
        pull = information * (self.parameters - self.prior.mean)[self.free]
        return normal, jacobian.T @ (self.residual * root).ravel() + pull

    def _step(self, before: float) -> float:
        """Take the first damped step that lowers the cost; return the cost."""
        normal, gradient = self.normal_equations()
        for _ in range(_TRIALS):
            damped = normal + sparse.diags_array(self.damping * normal.diagonal())
            tried = self.parameters.copy()
            tried[self.free] -= splu(sparse.csc_array(damped)).solve(gradient)
            residual = self._residuals(tried)
            after = self._cost(tried, residual)
            if after <= before:
                self.parameters, self.residual = tried, residual
                self.damping = max(_MIN_DAMPING, self.damping / 10.0)
                return after
            self.damping *= 10.0
        return before

    def _residuals(self, parameters: Float64Array) -> Float64Array:
        return self.matches.residuals(*self.unpacked(parameters))

    def _set_scale(self) -> None:
        median = float(np.median(np.linalg.norm(self.residual, axis=1)))
        self.noise = max(_MIN_NOISE_PIXELS, median / RAYLEIGH_MEDIAN)
        self.kernel = max(_MIN_KERNEL_PIXELS, _KERNEL_SIGMAS * self.noise)

    def _cost(self, parameters: Float64Array, residual: Float64Array) -> float:
        squares = np.sum(residual**2, axis=1) / self.kernel**2
        fit = (self.kernel / self.noise) ** 2 * float(self.matches.weight @ np.log1p(squares))
        change = parameters - self.prior.mean
        return 0.5 * fit + 0.5 * float(change @ (self.prior.information * change))


def adjust(
    pairs: Sequence[Pair],
    frames: Sequence[int],
    states: Float64Array,
    lens: Lens,
    mount: Mount,
    *,
    lens_free: LensFree = "bend",
    independent: float = CAUTIOUS_MATCHES,
) -> Bundle:
    """Return the adjustment of the states of `frames`, from a first guess.

    A focal length that is free stays near its prior where the frames do not determine it, as those
    that all look straight down do not.

    Parameters
    ----------
    pairs : sequence of Pair
        Between these frames, which they connect.
    states : (N, 6) float64
    lens_free : str
        What of the lens is estimated: ``none``, its ``bend``, or ``all``.
    independent : float
        For how many independent matches a pair counts at most.
    """
    numbers = {frame: number for number, frame in enumerate(frames)}
    few = independent < ALL_MATCHES and lens_free != "all"
    matches = _Matches(pairs, numbers, independent, _CAUTIOUS_KEPT if few else None)
    fixed = np.array([lens_free != "all", lens_free == "none"])
    prior, free = _prior(states, lens, mount, fixed)
    solver = _Solver(matches, prior, free, lens)
    solver.run()
    found, bent = solver.unpacked(solver.parameters)
    medians = matches.medians(solver.residual)
    information, _ = solver.normal_equations()
    return Bundle(found, bent, mount, medians, solver.noise, information, free)


def _prior(
    states: Float64Array, lens: Lens, mount: Mount, lens_fixed: BoolArray
) -> tuple[_Prior, IntpArray]:
    """Return the prior of all parameters, and which are free; `lens_fixed` of focal and bend."""
    mean, information = np.zeros_like(states), np.zeros_like(states)
    mean[0, :LOG_SCALE] = states[0, :LOG_SCALE]
    information[0, :LOG_SCALE] = _ANCHOR_INFORMATION
    information[:, LOG_SCALE] = mount.scale_sigma**-2.0
    fixed = np.zeros((len(states), STATES), np.bool_)
    if mount.tilt_sigma:
        information[:, PITCH:] = mount.tilt_sigma**-2.0
    else:
        fixed[:, PITCH:] = True
    focal = np.log(lens.focal_pixels)
    known = lens.prior or LensPrior(float(focal), 0.0)
    sigmas = np.array([known.focal_sigma, known.bend_sigma])
    lens_fixed = lens_fixed | (sigmas == 0.0)
    prior = _Prior(
        len(states),
        np.append(states.ravel(), [focal, lens.bend]),
        np.append(mean.ravel(), [known.log_focal, 0.0]),
        np.append(information.ravel(), np.where(lens_fixed, 1.0, sigmas) ** -2.0),
    )
    return prior, np.flatnonzero(~np.append(fixed.ravel(), lens_fixed))
