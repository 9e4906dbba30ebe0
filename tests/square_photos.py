"""Photographs of squares on floors whose every number is known.

The floor is a function of metres, averaged over each pixel, over four hundred places of it where
paint begins or ends, so that an edge lies where it is said to lie to a hundredth of a pixel. Light
is averaged, as in a camera, and encoded in the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache

import cv2
import numpy as np

from slamcli.core.camera.calibration import Intrinsics
from slamcli.core.camera.lens import distort_points, image_centre, undistort_points
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import apply_homography, invert
from slamcli.core.light import Gamma, codes_of_light, light_of_fractions

SIDE_METRES = 0.3048


@dataclass(frozen=True)
class Photo:
    """What to render; angles in degrees, lengths in metres, levels in gray."""

    seed: int = 0
    size: tuple[int, int] = (640, 480)
    focal: float = 560.0
    height: float = 0.3
    pitch: float = 35.0
    roll: float = 0.0
    centre: tuple[float, float] = (0.55, 0.0)
    yaw: float = 0.0
    side: float = SIDE_METRES
    square_level: float = 190.0
    floor_level: float = 60.0
    texture: float = 0.0
    square_texture: float = 0.0
    # A print that fills the square, 0 and 255, its upper edge away from a camera at yaw 0.
    sheet: np.ndarray | None = None
    disk: bool = False
    pattern: bool = False
    # Each line: start and end in units of the square's half side, in its own axes, width in metres.
    lines: tuple[tuple[float, float, float, float, float], ...] = ()
    other_squares: tuple[tuple[float, float, float, float], ...] = ()  # x, y, yaw, side
    boxes: tuple[tuple[float, float, float, float], ...] = ()  # x, y, length, width
    noise: float = 0.0
    blur: float = 0.0
    vignetting: float = 0.0
    gamma: Gamma = "srgb"
    # Share of an unsharp mask of one pixel, of the encoded picture.
    sharpening: float = 0.0
    distortion: tuple[float, ...] = field(default=(0.0,) * 5)
    distortion_model: str = "plumb_bob"

    @property
    def intrinsics(self) -> Intrinsics:
        column, row = image_centre(self.size)
        matrix = np.array([[self.focal, 0, column], [0, self.focal, row], [0, 0, 1]])
        return Intrinsics(matrix, np.array(self.distortion), self.distortion_model, self.size)  # type: ignore[arg-type]

    @property
    def image_from_robot(self) -> np.ndarray:
        return image_from_robot_homography(
            self.intrinsics.camera_matrix,
            self.height,
            math.radians(self.pitch),
            math.radians(self.roll),
        )

    @property
    def floor_corners(self) -> np.ndarray:
        """(4, 2) metres in the robot frame."""
        half = self.side / 2
        turned = rotation(self.yaw) @ np.array(
            [[-half, half, half, -half], [-half, -half, half, half]]
        )
        return turned.T + self.centre

    @property
    def corners(self) -> np.ndarray:
        """(4, 2) pixels of the photo."""
        undistorted = apply_homography(self.image_from_robot, self.floor_corners)
        return distort_points(self.intrinsics, undistorted)


def rotation(degrees: float) -> np.ndarray:
    angle = math.radians(degrees)
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def render(photo: Photo) -> np.ndarray:
    """Return the (H, W, 3) uint8 BGR photograph."""
    width, height = photo.size
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    paint, gray = _average(photo, pixels, 4)
    # Where paint changes within a pixel or beside it, more samples place the edge exactly.
    whole = paint.reshape(height, width).astype(np.float32)
    box = np.ones((3, 3), np.uint8)
    edge = (cv2.dilate(whole, box) != cv2.erode(whole, box)).ravel()
    _, gray[edge] = _average(photo, pixels[edge], 400)
    return _camera(photo, gray.reshape(height, width, 3))


def _average(photo: Photo, pixels: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) which paint, and (N, 3) BGR light, over n samples of each of (N, 2) pixels.

    The samples follow the plastic number, so that they lie evenly along rows and columns too.
    """
    plastic = 1.32471795724474602596
    offsets = (np.arange(n)[:, None] / [plastic, plastic**2] + 0.5) % 1.0 - 0.5
    samples = (pixels[:, None] + offsets).reshape(-1, 2)
    if any(photo.distortion):
        samples = undistort_points(photo.intrinsics, samples)
    h = invert(photo.image_from_robot)
    column, row = samples.T
    depth = h[2, 0] * column + h[2, 1] * row + h[2, 2]
    beyond = depth <= 1e-6
    depth[beyond] = 1e-6
    x = ((h[0, 0] * column + h[0, 1] * row + h[0, 2]) / depth).astype(np.float32)
    y = ((h[1, 0] * column + h[1, 1] * row + h[1, 2]) / depth).astype(np.float32)
    paint, gray = _floor(photo, x, y)
    paint[beyond], gray[beyond] = 4, 120.0
    colour = np.where((paint == 3)[:, None], np.float32([10, 10, 150]), gray[:, None])
    shape = (len(pixels), n)
    light = light_of_fractions(np.clip(colour, 0, 255), "srgb")
    return paint.reshape(shape).mean(axis=1), light.reshape(*shape, 3).mean(axis=1)


def _floor(photo: Photo, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at floor points which paint (0 none, 1 square, 2 pattern, 3 red) and gray level."""
    gray = photo.floor_level + photo.texture * _texture(x, y, photo.seed)
    axes = rotation(-photo.yaw)
    half = photo.side / 2
    u = (axes[0, 0] * (x - photo.centre[0]) + axes[0, 1] * (y - photo.centre[1])) / half
    v = (axes[1, 0] * (x - photo.centre[0]) + axes[1, 1] * (y - photo.centre[1])) / half
    level = photo.square_level + photo.square_texture * _texture(y, x, photo.seed)
    painted = (np.abs(u) <= 1) & (np.abs(v) <= 1)
    for u0, v0, u1, v1, line_width in photo.lines:
        length = math.hypot(u1 - u0, v1 - v0)
        along = ((u - u0) * (u1 - u0) + (v - v0) * (v1 - v0)) / length
        across = ((u - u0) * (v1 - v0) - (v - v0) * (u1 - u0)) / length
        painted |= (np.abs(across) * half <= line_width / 2) & (along >= 0) & (along <= length)
    for square_x, square_y, yaw, side in photo.other_squares:
        turn = rotation(-yaw)
        a = turn[0, 0] * (x - square_x) + turn[0, 1] * (y - square_y)
        b = turn[1, 0] * (x - square_x) + turn[1, 1] * (y - square_y)
        painted |= (np.abs(a) <= side / 2) & (np.abs(b) <= side / 2)
    for box_x, box_y, length, width in photo.boxes:
        painted |= (np.abs(x - box_x) <= length / 2) & (np.abs(y - box_y) <= width / 2)
    gray = np.where(painted, level, gray).astype(np.float32)
    paint = painted.astype(np.int8)
    if photo.sheet is not None:
        inside = (np.abs(u) < 1) & (np.abs(v) < 1)
        side = len(photo.sheet)
        row = ((1 - u[inside]) / 2 * side).astype(int)
        column = ((1 - v[inside]) / 2 * side).astype(int)
        dark = photo.sheet[row, column] == 0
        gray[inside] = np.where(dark, photo.floor_level, gray[inside])
        paint[inside] = np.where(dark, 2, 1)
    if photo.pattern:
        cell = (np.floor((u + 1) * 4).astype(int) + np.floor((v + 1) * 4).astype(int)) % 2
        marked = (np.abs(u) <= 0.5) & (np.abs(v) <= 0.5) & (cell == 0)
        gray[marked], paint[marked] = photo.floor_level, 2
    if photo.disk:
        paint[(u - 0.35) ** 2 + (v - 0.1) ** 2 <= 0.2**2] = 3
    return paint, gray


@cache
def _grain() -> np.ndarray:
    """Return tileable noise of several scales, zero mean and unit deviation."""
    side = 512
    generator = np.random.default_rng(1)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    total = np.zeros((side, side))
    for sigma in (1.0, 4.0, 24.0):
        spectrum = np.fft.fft2(generator.normal(size=(side, side)))
        smooth = np.fft.ifft2(spectrum * np.exp(-2 * (np.pi * sigma * frequency) ** 2)).real
        total += smooth / smooth.std()
    return ((total - total.mean()) / total.std()).astype(np.float32)


def _texture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Sample the grain at half a millimetre; each seed has its own piece of floor."""
    grain, scale = _grain(), np.float32(2000.0)
    column = (x * scale).astype(np.int64) + 7919 * seed
    row = (y * scale).astype(np.int64) + 104729 * seed
    return grain[row % len(grain), column % len(grain)]


def _camera(photo: Photo, image: np.ndarray) -> np.ndarray:
    width, height = photo.size
    if photo.blur:
        image = cv2.GaussianBlur(image, (0, 0), photo.blur)
    if photo.vignetting:
        columns, rows = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
        image = image * (1 - photo.vignetting * (columns**2 + rows**2) / 2)[..., None]
    generator = np.random.default_rng([photo.seed, 2])
    image = codes_of_light(image, photo.gamma)
    if photo.sharpening:
        image = image + photo.sharpening * (image - cv2.GaussianBlur(image, (0, 0), 1.0))
    image = image + photo.noise * generator.normal(size=image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def random_photo(seed: int, *, hard: bool) -> Photo:
    """Return a square seen whole by a random camera; a hard one with all that may disturb it."""
    generator = np.random.default_rng([seed, 3])
    while True:
        photo = _draw(seed, generator)
        corners, (width, height) = photo.corners, photo.size
        depth = photo.floor_corners @ photo.image_from_robot[2, :2] + photo.image_from_robot[2, 2]
        if (depth <= 0).any():
            continue
        inside = np.all((corners > 6) & (corners < (width - 7, height - 7)))
        x, y = corners.T
        area = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
        if inside and area > 0.03 * width * height:
            return _disturb(photo, generator) if hard else photo


def _draw(seed: int, generator: np.random.Generator) -> Photo:
    width, height = [(640, 480), (640, 360), (800, 600)][int(generator.integers(3))]
    pitch = generator.uniform(15, 60)
    camera_height = generator.uniform(0.1, 0.6)
    distance = camera_height / math.tan(math.radians(pitch)) * generator.uniform(0.7, 1.6)
    dark = generator.random() < 0.3
    return Photo(
        seed=seed,
        size=(width, height),
        focal=width * generator.uniform(0.5, 1.3),
        height=camera_height,
        pitch=pitch,
        roll=generator.uniform(-5, 5),
        centre=(distance, distance * generator.uniform(-0.3, 0.3)),
        yaw=generator.uniform(-45, 45) if generator.random() < 0.7 else generator.uniform(-2, 2),
        square_level=generator.uniform(20, 60) if dark else generator.uniform(150, 220),
        floor_level=generator.uniform(120, 180) if dark else generator.uniform(25, 90),
        noise=generator.uniform(3, 8),
    )


def _disturb(photo: Photo, generator: np.random.Generator) -> Photo:
    lines = []
    for _ in range(int(generator.integers(0, 3))):
        turn = int(generator.integers(4)) * 90
        place = float(generator.choice([-0.9, 0.9, generator.uniform(-0.7, 0.7)]))
        start, end = rotation(turn) @ [1.0, place], rotation(turn) @ [5.0, place]
        lines.append((*start, *end, float(generator.uniform(0.015, 0.045))))
    return replace(
        photo,
        texture=generator.uniform(0, 14),
        square_texture=generator.uniform(0, 6),
        disk=bool(generator.random() < 0.5),
        pattern=bool(generator.random() < 0.4),
        lines=tuple(lines),
        noise=generator.uniform(4, 10),
        blur=generator.uniform(0, 1.2),
        vignetting=generator.uniform(0, 0.5),
    )
