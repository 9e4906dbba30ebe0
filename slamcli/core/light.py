"""Light and its 8-bit code: the sRGB transfer function (IEC 61966-2-1) and plain powers."""

from __future__ import annotations

from functools import cache
from typing import Final, Literal

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array, UInt16Array

# How a picture's values encode light: sRGB, not at all, or as a power of it, such as 2.2.
Gamma = float | Literal["srgb", "linear"]

# Light of white, and its code.
SATURATION: Final = 255.0
_FULL_SCALE_16_BITS = 65535.0


@cache
def light_of_codes(gamma: Gamma = "srgb") -> Float64Array:
    """Return (256,) the light, 255 for white, of each 8-bit value; read-only."""
    value = np.arange(256) / SATURATION
    if gamma == "srgb":
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    else:
        light = value ** (1.0 if gamma == "linear" else gamma)
    table: Float64Array = SATURATION * light
    table.setflags(write=False)
    return table


def light_of_image(image: UInt8Array, gamma: Gamma) -> Float32Array:
    """Return the light, 255 for white, of an 8-bit picture of any shape."""
    return np.asarray(light_of_codes(gamma), np.float32)[image]


def light_of_fractions(codes: Float64Array, gamma: Gamma) -> Float64Array:
    """Return the light of codes of any shape that are not rounded."""
    light: Float64Array = np.interp(codes, np.arange(256.0), light_of_codes(gamma))
    return light


def codes_of_light(light: Float64Array, gamma: Gamma) -> Float64Array:
    """Return the codes, 0 to 255 and not rounded, of light of any shape."""
    codes: Float64Array = np.interp(light, light_of_codes(gamma), np.arange(256.0))
    return codes


def light_of_gray(gray: float) -> float:
    """Return the light, 255 for white, of an sRGB gray level from 0 to 255."""
    value = gray / SATURATION
    return SATURATION * (value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4)


def light_in_16_bits(encoded: UInt8Array) -> UInt16Array:
    """Return the light, 0 to 65535, of 8-bit sRGB values of any shape."""
    return np.asarray(cv2.LUT(encoded, _light_table_of_16_bits()), np.uint16)


def encode(light: Float32Array) -> Float32Array:
    """Return sRGB values from 0 to 255, not rounded, of light from 0 to 255; clipped to both."""
    index = np.clip(light, 0.0, SATURATION) * np.float32(_FULL_SCALE_16_BITS / SATURATION)
    return _code_table_of_16_bits()[(index + np.float32(0.5)).astype(np.uint16)]


@cache
def _light_table_of_16_bits() -> UInt16Array:
    return np.rint(light_of_codes() * (_FULL_SCALE_16_BITS / SATURATION)).astype(np.uint16)


@cache
def _code_table_of_16_bits() -> Float32Array:
    light = np.arange(65536) / _FULL_SCALE_16_BITS
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (SATURATION * code).astype(np.float32)
