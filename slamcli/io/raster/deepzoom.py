"""Deep Zoom pyramids (Microsoft's DZI, 2009 schema), to view a map of any size in a browser."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import InputError, OutputError
from slamcli.io.files import read_text, write_image, write_text
from slamcli.io.raster.tile_store import reduced


def write_deep_zoom(
    folder: Path,
    name: str,
    size: tuple[int, int],
    tile_pixels: int,
    tiles: Iterable[tuple[int, int, UInt8Array]],
) -> None:
    """Write NAME.dzi and NAME_files/LEVEL/COLUMN_ROW.png; tiles that show nothing are left out.

    Each level halves the one below it, which is read back four tiles at a time: memory does not
    grow with the size.

    Parameters
    ----------
    size : (int, int)
        Width and height, pixels.
    tiles : iterable of (row, column, (tile, tile, 4) uint8 BGRA)
        Of the finest level, by tile counts from the upper left corner.
    """
    width, height = size
    level = max(0, (max(width, height) - 1).bit_length())
    pyramid = folder / f"{name}_files"
    places: set[tuple[int, int]] = set()
    for row, column, pixels in tiles:
        part = pixels[: height - row * tile_pixels, : width - column * tile_pixels]
        write_image(pyramid / str(level) / f"{column}_{row}.png", part)
        places.add((row, column))
    while level > 0:
        parents = sorted({(row // 2, column // 2) for row, column in places})
        width, height = -(-width // 2), -(-height // 2)
        for row, column in parents:
            children = _children(pyramid / str(level), row, column, tile_pixels)
            image, mask = reduced(children[..., :3], children[..., 3], 2)
            part = np.dstack([image, mask])[
                : height - row * tile_pixels, : width - column * tile_pixels
            ]
            write_image(pyramid / str(level - 1) / f"{column}_{row}.png", part)
        places, level = set(parents), level - 1
    write_text(
        folder / f"{name}.dzi",
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Image xmlns="http://schemas.microsoft.com/deepzoom/2009" Format="png" Overlap="0" '
        f'TileSize="{tile_pixels}"><Size Width="{size[0]}" Height="{size[1]}"/></Image>\n',
    )


def write_position(path: Path, position: Mapping[str, object]) -> None:
    """Write where a pyramid lies, as JSON beside its .dzi; that format has no place for it."""
    write_text(path, json.dumps(position, indent=1) + "\n")


def read_position(path: Path) -> dict[str, object]:
    """Return what `write_position` wrote.

    Raises
    ------
    InputError
    """
    try:
        return dict(json.loads(read_text(path, "position of a pyramid")))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged: {error}") from error


def _children(folder: Path, row: int, column: int, tile_pixels: int) -> UInt8Array:
    """Return the four tiles under one, as one picture; transparent where there is none."""
    children = np.zeros((2 * tile_pixels, 2 * tile_pixels, 4), np.uint8)
    for down in (0, 1):
        for right in (0, 1):
            path = folder / f"{2 * column + right}_{2 * row + down}.png"
            if not path.is_file():
                continue
            pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
            if pixels is None:
                raise OutputError(f"cannot read back {path}")
            top, left = down * tile_pixels, right * tile_pixels
            children[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return children
