"""Poured floors, aperiodic ones: asphalt, concrete, terrazzo and a bare slab."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.geometry import Grid
from slamcli.simulation.config import FloorOptions
from slamcli.simulation.floors.noise import Seed, smooth_noise, tinted


def asphalt(grid: Grid, _options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint stones of a few millimetres in a binder, patches, and some light and dark chips."""
    stones = smooth_noise(grid, seed + 1, 0.0016)
    fine = smooth_noise(grid, seed + 2, 0.0007)
    gravel = smooth_noise(grid, seed + 3, 0.0045)
    patches = smooth_noise(grid, seed + 4, 0.06) + smooth_noise(grid, seed + 5, 0.4)
    chips = np.maximum(smooth_noise(grid, seed + 6, 0.0022) - 1.9, 0.0)
    pits = np.maximum(smooth_noise(grid, seed + 7, 0.0030) - 1.7, 0.0)
    gray = 104 + 15 * np.tanh(stones) + 7 * fine + 8 * gravel + 5 * patches
    gray += 70 * chips - 55 * pits
    return tinted(gray, (1.02, 1.0, 0.98))


def concrete(grid: Grid, _options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint a trowelled slab: grain, clouds, pores, and the sweep of the trowel."""
    grain = smooth_noise(grid, seed + 11, 0.0008)
    trowel = smooth_noise(grid, seed + 15, 0.003, stretch=4.0)
    clouds = smooth_noise(grid, seed + 12, 0.03) + smooth_noise(grid, seed + 13, 0.15)
    pores = np.maximum(smooth_noise(grid, seed + 14, 0.0017) - 2.2, 0.0)
    stains = np.maximum(smooth_noise(grid, seed + 16, 0.006) - 1.8, 0.0)
    gray = 140 + 3.5 * grain + 4.0 * trowel + 4.0 * clouds - 70 * pores - 25 * stains
    return tinted(gray, (0.97, 1.0, 1.02))


def terrazzo(grid: Grid, _options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint chips of marble, from three to fifteen millimetres, ground flat in a light cement."""
    gray = 186 + 3.0 * smooth_noise(grid, seed + 71, 0.0008)
    for number, (size_metres, share) in enumerate(((0.0045, 0.9), (0.0022, 1.1), (0.0011, 1.2))):
        shape = smooth_noise(grid, seed + 72 + number, size_metres)
        tone = 55.0 * smooth_noise(grid, seed + 76 + number, 1.5 * size_metres)
        # Chips have sharp rims: a steep ramp, so that a pixel on the rim is still mixed.
        chip = np.clip((shape - share) * 12.0, 0.0, 1.0)
        gray = (1.0 - chip) * gray + chip * (150 + tone)
    return tinted(gray.astype(np.float32), (0.95, 1.0, 1.02))


def bare(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint a smooth sealed slab with next to no grain, and a few marks a square metre."""
    grain = smooth_noise(grid, seed + 81, 0.0010)
    clouds = smooth_noise(grid, seed + 82, 0.10)
    scuffs = np.maximum(smooth_noise(grid, seed + 83, 0.0030, stretch=8.0) - 2.3, 0.0)
    stains = np.maximum(smooth_noise(grid, seed + 84, 0.008) - 2.0, 0.0)
    gray = 150 + 0.8 * grain + 3.0 * clouds
    gray -= (0.3 + options.wear) * (90.0 * scuffs + 60.0 * stains)
    return tinted(gray, (0.98, 1.0, 1.01))


def road(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint asphalt with a dashed line along x every metre, an edge line, and cracks."""
    ground = asphalt(grid, options, seed).astype(np.float32)
    matrix = grid.metres_from_pixel
    x = matrix[0, 0] * np.arange(grid.width) + matrix[0, 2]
    y = matrix[1, 1] * np.arange(grid.height) + matrix[1, 2]
    dashed = (np.abs((y[:, None] + 0.5) % 1.0 - 0.5) < 0.03) & (x[None, :] % 0.6 < 0.3)
    worn = smooth_noise(grid, seed + 8, 0.004) > 2.0 - 1.6 * options.wear
    paint = np.where(dashed & ~worn, 1.0, 0.0).astype(np.float32)[..., None]
    crack = np.abs(smooth_noise(grid, seed + 9, 0.12)) < 0.006 * options.wear
    ground = np.where(crack[..., None], 0.55 * ground, ground)
    white = 205.0 + 0.25 * (ground - 104.0)
    return np.clip(np.round(ground + paint * (white - ground)), 0, 255).astype(np.uint8)
