"""Light and its 8-bit code: the sRGB transfer function (IEC 61966-2-1), both ways."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array, UInt16Array

SATURATION = 255.0
_FULL_SCALE_16_BITS = 65535.0


def light_from_encoded(encoded: UInt8Array) -> UInt16Array:
    """Return the light, 0 to 65535, of 8-bit sRGB values of any shape."""
    return _LIGHT_OF_8_BITS[encoded]


def light_of_gray(gray: float) -> float:
    """Return the light, 255 for white, of an encoded gray level from 0 to 255."""
    return SATURATION * _decode(gray / 255.0)


def encode(light: Float32Array) -> Float32Array:
    """Return sRGB values from 0 to 255, not rounded, of light from 0 to 255; clipped to both."""
    index = np.clip(light, 0.0, SATURATION) * np.float32(_FULL_SCALE_16_BITS / SATURATION)
    return _CODE_OF_16_BITS[(index + np.float32(0.5)).astype(np.uint16)]


def _decode(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def _encoding_table() -> Float32Array:
    light = np.arange(65536) / _FULL_SCALE_16_BITS
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255.0 * code).astype(np.float32)


_LIGHT_OF_8_BITS = np.array(
    [round(_FULL_SCALE_16_BITS * _decode(value / 255.0)) for value in range(256)], np.uint16
)
_CODE_OF_16_BITS = _encoding_table()
