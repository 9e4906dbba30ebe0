"""Generator of everything in this folder: `python samples/make.py`.

The course is a simulated drive; the three pairs replace the pictures of the 2015 thesis's
Appendix A, drawn here, each with a transform known exactly.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.io.files import write_image, write_text
from slamcli.run.session.session import Session
from slamcli.run.simulate import simulate
from slamcli.simulation.config import FloorOptions, ImagingOptions, SimulationOptions

FOLDER = Path(__file__).resolve().parent
WHITE = (255, 255, 255)
COURSE = SimulationOptions(
    floor="course",
    surface=FloorOptions(wear=0.5),
    imaging=ImagingOptions(light=False),
    path="loop",
    length_metres=3.2,
    frames=40,
    jpeg_quality=85,
    seed=7,
)

Picture = NDArray[np.uint8]


def similarity(
    scale: float, rotation_degrees: float, translation: tuple[float, float]
) -> NDArray[np.float64]:
    """Return (3, 3) second_from_first in image axes; positive rotation turns x towards y."""
    cosine = scale * math.cos(math.radians(rotation_degrees))
    sine = scale * math.sin(math.radians(rotation_degrees))
    return np.array([[cosine, -sine, translation[0]], [sine, cosine, translation[1]], [0, 0, 1.0]])


def warp(picture: Picture, to_from_picture: NDArray[np.float64], size: tuple[int, int]) -> Picture:
    """Move a picture onto a white canvas, smoothed first where it shrinks."""
    warped = cv2.warpAffine(
        picture, to_from_picture[:2], size, flags=cv2.INTER_CUBIC, borderValue=WHITE
    )
    return np.asarray(warped, np.uint8)


def grained(
    picture: Picture, generator: np.random.Generator, sigma: float, amount: float
) -> Picture:
    """Add smooth noise, as canvas, grass or plaster have it."""
    noise = generator.standard_normal(picture.shape[:2], dtype=np.float32)
    blurred = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma))
    textured = picture + (amount / blurred.std() * blurred)[..., None]
    return np.asarray(np.clip(textured, 0, 255), np.uint8)


def draw_figure(
    canvas: Picture, foot: tuple[int, int], height: int, shirt: tuple[int, ...]
) -> None:
    """Draw a walking person whose feet are at a pixel."""
    x, y = foot
    unit = height / 8

    def at(right: float, up: float) -> tuple[int, int]:
        return round(x + right * unit), round(y - up * unit)

    thick = max(2, round(0.9 * unit))
    for right in (-1.0, 1.2):
        cv2.line(canvas, at(0, 3.8), at(right, 0.2), (35, 30, 28), thick, cv2.LINE_AA)
        cv2.line(canvas, at(right, 0.2), at(right + 0.6, 0.1), (225, 225, 230), thick, cv2.LINE_AA)
    cv2.ellipse(
        canvas, at(0, 5.2), (round(unit), round(1.7 * unit)), 8, 0, 360, shirt, -1, cv2.LINE_AA
    )
    cv2.line(canvas, at(-0.2, 6.2), at(-1.3, 4.0), (120, 150, 205), thick // 2 + 1, cv2.LINE_AA)
    cv2.line(canvas, at(0.3, 6.2), at(1.3, 4.2), (120, 150, 205), thick // 2 + 1, cv2.LINE_AA)
    cv2.circle(canvas, at(0.1, 7.4), round(0.8 * unit), (125, 155, 210), -1, cv2.LINE_AA)
    cv2.ellipse(
        canvas, at(0, 7.7), (round(0.85 * unit), round(0.55 * unit)), 0, 180, 360, (30, 40, 60), -1
    )


def draw_field(generator: np.random.Generator) -> Picture:
    """Return a meadow with a wood, a barn, a fence and people (960 x 700)."""
    height, width = 700, 960
    picture = np.empty((height, width, 3), np.uint8)
    shade = np.linspace(0, 1, height)[:, None]
    picture[:] = np.round((1 - shade) * (90, 200, 170) + shade * (60, 170, 120)).astype(np.uint8)[
        :, None
    ]
    picture[:110] = (235, 215, 190)
    for _ in range(1500):
        x, y = int(generator.integers(width)), int(generator.normal(190, 38))
        colour = generator.uniform((20, 50, 30), (70, 120, 90))
        cv2.circle(
            picture,
            (x, min(y, 290)),
            int(generator.integers(4, 16)),
            colour.tolist(),
            -1,
            cv2.LINE_AA,
        )
    picture[300:] = grained(picture[300:], generator, 1.2, 16)
    cv2.fillPoly(
        picture,
        [np.array([[330, 300], [330, 220], [400, 180], [470, 220], [470, 300]])],
        (50, 45, 130),
    )
    cv2.fillPoly(
        picture,
        [np.array([[320, 222], [400, 174], [480, 222], [470, 232], [400, 190], [330, 232]])],
        (180, 180, 185),
    )
    for x in range(0, width, 48):
        cv2.line(picture, (x, 290), (x, 330), (110, 120, 125), 2, cv2.LINE_AA)
    for y in (298, 312):
        cv2.line(picture, (0, y), (width, y), (130, 135, 140), 1, cv2.LINE_AA)
    people = (
        (120, 420, 46, (150, 90, 40)),
        (300, 470, 60, (40, 40, 60)),
        (560, 455, 56, (60, 60, 170)),
        (760, 480, 58, (70, 90, 60)),
        (880, 600, 110, (150, 60, 110)),
        (200, 640, 120, (40, 150, 200)),
    )
    for x, y, tall, shirt in people:
        draw_figure(picture, (x, y), tall, shirt)
    return grained(picture, generator, 0.9, 5)


def make_figure_in_field(
    generator: np.random.Generator,
) -> tuple[Picture, Picture, tuple[float, ...]]:
    """Return a small blurred crop, the field, and crop-to-field as scale, degrees, x, y."""
    field = draw_field(generator)
    scale, left, top = 0.68, 520.0, 390.0
    crop_from_field = np.linalg.inv(similarity(scale, 0.0, (left, top)))
    crop = warp(cv2.GaussianBlur(field, (0, 0), 0.6), crop_from_field, (124, 156))
    return np.asarray(cv2.GaussianBlur(crop, (0, 0), 1.1), np.uint8), field, (scale, 0.0, left, top)


def draw_portrait(generator: np.random.Generator) -> Picture:
    """Return a face in facets (620 x 800)."""
    width, height = 620, 800
    picture = np.full((height, width, 3), (150, 110, 60), np.uint8)
    points = generator.uniform((0, 0), (width, height), (170, 2))
    subdivision = cv2.Subdiv2D((0, 0, width, height))
    for point in points:
        subdivision.insert((float(point[0]), float(point[1])))
    facets, centres = subdivision.getVoronoiFacetList([])
    for facet, centre in zip(facets, centres, strict=True):
        face = ((centre[0] - 310) / 190) ** 2 + ((centre[1] - 330) / 260) ** 2 < 1
        base = (
            np.array((150, 190, 235) if face else (140, 100, 50))
            if centre[1] < 560
            else np.array((60, 140, 40))
        )
        colour = np.clip(base + generator.uniform(-55, 55, 3), 0, 255)
        shape = np.round(facet).astype(np.int32)
        cv2.fillConvexPoly(picture, shape, colour.tolist(), cv2.LINE_AA)
        cv2.polylines(
            picture, [shape], isClosed=True, color=(25, 20, 20), thickness=3, lineType=cv2.LINE_AA
        )
    for x, y, tilt in ((230, 270, 12), (400, 250, -25)):
        cv2.ellipse(picture, (x, y), (62, 32), tilt, 0, 360, (245, 250, 250), -1, cv2.LINE_AA)
        cv2.circle(picture, (x, y), 24, (150, 90, 30), -1, cv2.LINE_AA)
        for angle in range(0, 360, 30):
            end = (
                round(x + 22 * math.cos(math.radians(angle))),
                round(y + 22 * math.sin(math.radians(angle))),
            )
            cv2.line(picture, (x, y), end, (60, 40, 10), 2, cv2.LINE_AA)
        cv2.ellipse(picture, (x, y), (62, 32), tilt, 0, 360, (10, 10, 10), 4, cv2.LINE_AA)
    cv2.polylines(
        picture,
        [np.array([[330, 250], [270, 400], [345, 410]])],
        isClosed=False,
        color=(20, 20, 30),
        thickness=6,
        lineType=cv2.LINE_AA,
    )
    cv2.fillPoly(
        picture,
        [np.array([[240, 480], [330, 455], [400, 490], [320, 510]])],
        (50, 40, 170),
        cv2.LINE_AA,
    )
    for number in range(9):
        cv2.ellipse(
            picture,
            (470, 690),
            (14 + 13 * number, 9 + 9 * number),
            20,
            0,
            360,
            (90, 30, 120),
            3,
            cv2.LINE_AA,
        )
    return grained(picture, generator, 1.0, 6)


def make_portrait(generator: np.random.Generator) -> tuple[Picture, Picture, tuple[float, ...]]:
    """Return the portrait turned on a white canvas, as painted, and turned-to-painted."""
    portrait = draw_portrait(generator)
    truth = (1.0, -20.0, -116.0, 128.0)
    painted_from_turned = similarity(truth[0], truth[1], (truth[2], truth[3]))
    size = (portrait.shape[1], portrait.shape[0])
    return warp(portrait, np.linalg.inv(painted_from_turned), size), portrait, truth


def draw_facade(generator: np.random.Generator) -> Picture:
    """Return a block of flats whose windows repeat, under a sky (820 x 690)."""
    width, height = 820, 690
    shade = np.linspace(0, 1, height)[:, None]
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = np.round((1 - shade) * (225, 180, 140) + shade * (245, 225, 205)).astype(np.uint8)[
        :, None
    ]
    cv2.rectangle(picture, (60, 120), (540, 690), (150, 165, 180), -1)
    cv2.rectangle(picture, (540, 300), (800, 690), (120, 130, 150), -1)
    for row in range(12):
        for column in range(9):
            x, y = 78 + 51 * column, 138 + 46 * row
            cv2.rectangle(picture, (x, y), (x + 34, y + 28), (90, 70, 50), -1)
            cv2.rectangle(picture, (x, y), (x + 34, y + 28), (230, 235, 240), 2)
            if generator.random() < 0.3:
                cv2.rectangle(
                    picture,
                    (x + 3, y + 3),
                    (x + 31, y + 13),
                    generator.uniform(90, 230, 3).tolist(),
                    -1,
                )
            cv2.line(picture, (x - 4, y + 34), (x + 38, y + 34), (110, 115, 125), 3)
    for row in range(9):
        for column in range(5):
            x, y = 556 + 49 * column, 318 + 42 * row
            cv2.rectangle(picture, (x, y), (x + 30, y + 24), (60, 60, 70), -1)
    for number in range(26):
        angle = math.radians(200 + 5.5 * number)
        start = (round(300 + 90 * math.cos(angle)), round(128 + 40 * math.sin(angle)))
        end = (round(300 + 230 * math.cos(angle)), round(128 + 118 * math.sin(angle)))
        cv2.line(picture, start, end, generator.uniform(60, 210, 3).tolist(), 13, cv2.LINE_AA)
    return grained(picture, generator, 1.0, 6)


def make_facade(generator: np.random.Generator) -> tuple[Picture, Picture, tuple[float, ...]]:
    """Return the facade, a turned cut-out of it on a smaller canvas, and facade-to-cut-out."""
    facade = draw_facade(generator)
    truth = (1.0, -27.3, -90.0, 180.0)
    cut_from_facade = similarity(truth[0], truth[1], (truth[2], truth[3]))
    return facade, warp(facade, cut_from_facade, (420, 560)), truth


def main() -> None:
    """Write samples/course and samples/appendix_a."""
    simulate(FOLDER / "course", COURSE, overwrite=True, session=Session(workers=2))
    with tempfile.TemporaryDirectory() as folder:
        # Where half of the light lies is where its edges are, as `slam calibrate` has it.
        photographed = replace(COURSE, frames=1, imaging=ImagingOptions())
        simulate(Path(folder) / "square", photographed, overwrite=True, session=Session(workers=1))
        shutil.copy(Path(folder) / "square" / "square.png", FOLDER / "course")
    rows = ["first,second,scale,rotation_degrees,x,y"]
    pairs = (
        ("figure", "field", make_figure_in_field),
        ("portrait_turned", "portrait", make_portrait),
        ("facade", "facade_turned", make_facade),
    )
    for number, (first, second, make) in enumerate(pairs):
        one, two, truth = make(np.random.default_rng([2015, number]))
        write_image(FOLDER / "appendix_a" / f"{first}.jpg", one, jpeg_quality=88)
        write_image(FOLDER / "appendix_a" / f"{second}.jpg", two, jpeg_quality=88)
        rows.append(f"{first}.jpg,{second}.jpg," + ",".join(f"{value:g}" for value in truth))
    write_text(FOLDER / "appendix_a" / "truth.csv", "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
