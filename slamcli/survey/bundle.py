"""Bundle adjustment of a survey: poses, tilts and heights of all frames, and their common lens.

Every match gives a transfer residual, in undistorted pixels of one of its frames: where the other
frame's point comes out through the plane, minus where it was seen. The robust least squares
(Cauchy's kernel) is solved by Levenberg and Marquardt's method on sparse normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from slamcli.core.arrays import Float64Array, IntpArray
from slamcli.core.robust import RAYLEIGH_MEDIAN
from slamcli.survey.pairs import Pair
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES, project, undistort

# A pair counts for at most this many independent matches while the mount is learned: what errors
# they have, of relief and lens, they have in common [benchmarks/real_sets.py: with all 150 the tilt
# of seabeds is learned as 20 degrees]. With the mount known all of them count, for a sharper map.
CAUTIOUS_MATCHES, ALL_MATCHES = 10.0, 1e9
# Cauchy's scale and the assumed noise, from the median residual, and their floors.
_KERNEL_SIGMAS, _MIN_KERNEL_PIXELS, _MIN_NOISE_PIXELS = 3.0, 1.0, 0.1
_ITERATIONS, _TRIALS, _CONVERGED_SHARE = 25, 8, 1e-5
_DAMPING, _MIN_DAMPING = 1e-4, 1e-9
_BEHIND_PIXELS = 1e4
_ANCHOR_INFORMATION = 1e8
# Sigma of the prior of the lens's bend.
_BEND_SIGMA = 0.05
# The sigmas of tilt and scale are learned within these limits, from the states of at most so many
# frames.
_MIN_SIGMA, _MAX_TILT_SIGMA, _MAX_SCALE_SIGMA, _LEARN_FRAMES = 1e-3, 0.25, 0.5, 40
# The first guess of the tilt's sigma, radians, counts for so many frames.
_GUESS_TILT, _GUESS_FRAMES = 0.02, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """The lens that all frames share.

    Attributes
    ----------
    focal_pixels : float
    bend : float
        Radial distortion in the corners: a share of the radius.
    radius_pixels : float
        Of the corners.
    """

    focal_pixels: float
    bend: float
    radius_pixels: float


@dataclass(frozen=True, slots=True)
class Mount:
    """How freely the camera moves: sigmas of the priors of every frame's tilt and scale.

    Attributes
    ----------
    tilt_sigma : float
        Radians, of pitch and roll; 0 for a camera that is fixed looking straight down.
    scale_sigma : float
        Of the logarithm of the scale.
    """

    tilt_sigma: float
    scale_sigma: float


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

    def __init__(self, pairs: Sequence[Pair], number: dict[int, int], independent: float) -> None:
        counts = np.array([len(pair.pixels_a) for pair in pairs])
        self.pair = np.repeat(np.arange(len(pairs)), counts)
        a = np.repeat([number[pair.a] for pair in pairs], counts)
        b = np.repeat([number[pair.b] for pair in pairs], counts)
        pixels_a = np.concatenate([pair.pixels_a for pair in pairs])
        pixels_b = np.concatenate([pair.pixels_b for pair in pairs])
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
        image_from_map = project(states, lens.focal_pixels).image_from_map
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
        found = project(states, lens.focal_pixels)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """Start of all parameters, and their Gaussian priors: means, and information."""

    frames: int
    start: Float64Array
    mean: Float64Array
    information: Float64Array


class _Solver:
    """Levenberg and Marquardt's iterations from a first guess."""

    def __init__(self, matches: _Matches, prior: _Prior, free: IntpArray, radius: float) -> None:
        self.matches, self.prior, self.free, self.radius_pixels = matches, prior, free, radius
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
        lens = Lens(float(np.exp(parameters[-2])), float(parameters[-1]), self.radius_pixels)
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
    lens_known: bool = False,
    independent: float = CAUTIOUS_MATCHES,
) -> Bundle:
    """Return the adjustment of the states of `frames`, from a first guess.

    The focal length stays as it is: frames that look straight down do not determine it.

    Parameters
    ----------
    pairs : sequence of Pair
        Between these frames, which they connect.
    states : (N, 6) float64
    lens_known : bool
        Leave the lens's bend as it is.
    independent : float
        For how many independent matches a pair counts at most.
    """
    numbers = {frame: number for number, frame in enumerate(frames)}
    matches = _Matches(pairs, numbers, independent)
    prior, free = _prior(states, lens, mount, lens_known=lens_known)
    solver = _Solver(matches, prior, free, lens.radius_pixels)
    solver.run()
    found, bent = solver.unpacked(solver.parameters)
    medians = matches.medians(solver.residual)
    information, _ = solver.normal_equations()
    return Bundle(found, bent, mount, medians, solver.noise, information, free)


def learned_mount(bundle: Bundle) -> Mount:
    """Return the mount that explains the states best: a step of expectation maximisation."""
    frames = len(bundle.states)
    some = np.unique(np.linspace(0, frames - 1, min(frames, _LEARN_FRAMES)).round().astype(int))
    columns = [LOG_SCALE, PITCH, ROLL]
    variances = np.array([np.diag(c) for c in covariances(bundle, some.tolist(), columns)])
    # About their mean: a tilt that all frames share tilts the map, and is mostly the lens's.
    squares = np.var(bundle.states[:, columns], axis=0) + variances.mean(axis=0)
    known = frames / (frames + _GUESS_FRAMES)
    scale = np.sqrt(squares[0])
    tilt = np.sqrt(known * squares[1:].mean() + (1.0 - known) * _GUESS_TILT**2)
    return Mount(
        float(np.clip(tilt, _MIN_SIGMA, _MAX_TILT_SIGMA)),
        float(np.clip(scale, _MIN_SIGMA, _MAX_SCALE_SIGMA)),
    )


def covariances(
    bundle: Bundle, frames: Sequence[int], columns: Sequence[int]
) -> list[Float64Array]:
    """Return the covariance of some numbers of the states of some frames; 0 of what is fixed."""
    solver = splu(bundle.information)
    place = np.full(STATES * len(bundle.states) + 2, -1)
    place[bundle.free] = np.arange(len(bundle.free))
    found = []
    for frame in frames:
        own = place[STATES * frame + np.array(columns)]
        known = own >= 0
        unit = np.zeros((len(bundle.free), int(known.sum())))
        unit[own[known], np.arange(unit.shape[1])] = 1.0
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(known, known)] = solver.solve(unit)[own[known]]
        found.append(0.5 * (covariance + covariance.T))
    return found


def _prior(
    states: Float64Array, lens: Lens, mount: Mount, *, lens_known: bool
) -> tuple[_Prior, IntpArray]:
    """Return the prior of all parameters, and which are free."""
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
    prior = _Prior(
        len(states),
        np.append(states.ravel(), [focal, lens.bend]),
        np.append(mean.ravel(), [focal, 0.0]),
        np.append(information.ravel(), [1.0, _BEND_SIGMA**-2.0]),
    )
    return prior, np.flatnonzero(~np.append(fixed.ravel(), [True, lens_known]))
