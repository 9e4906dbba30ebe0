"""Drawing of a correlation surface: the score of every translation of a pixel search."""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array

_SIDE_PIXELS = 480
_LABEL_COLOUR = (255, 255, 255)
_BEST_COLOUR = (255, 255, 255)


def draw_surface(surface: Float32Array, metres_per_pixel: float) -> UInt8Array:
    """Return the score of every translation, the best over all turns, from dark (0) to bright (1).

    Parameters
    ----------
    surface : (h, w) float32
        Correlation; x to the right, y up, no motion in the middle.
    metres_per_pixel : float

    Returns
    -------
    (h', w', 3) uint8 BGR
        The best translation is ringed.
    """
    scale = _SIDE_PIXELS / max(surface.shape)
    size = (round(surface.shape[1] * scale), round(surface.shape[0] * scale))
    gray = np.clip(np.round(255 * surface), 0, 255).astype(np.uint8)
    coloured = cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO)
    canvas = np.asarray(cv2.resize(coloured, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    centre = (round((int(column) + 1 / 2) * scale), round((int(row) + 1 / 2) * scale))
    cv2.circle(canvas, centre, 12, _BEST_COLOUR, 1, cv2.LINE_AA)
    text = f"correlation {surface.max():.2f} by translation; {surface.shape[1]} x "
    text += f"{surface.shape[0]} cells of {metres_per_pixel * 1000:.3g} mm"
    cv2.putText(
        canvas, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _LABEL_COLOUR, 1, cv2.LINE_AA
    )
    return canvas
