"""Damaged pictures: how many are noticed, false alarms on good ones, and the decode time.

Run: python benchmarks/damaged_pictures.py [--each 150] [--good 1000] [--folder FRAMES]. Frames of
the samples, a textured floor and plain ones are encoded in many ways by Pillow, OpenCV and
simplejpeg, damaged in one of five ways, and read. A damaged picture is wrong where it differs by
more than eight gray levels from the undamaged one. Needs the development dependencies.
"""

from __future__ import annotations

import argparse
import io
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.io.images.decoding import Reading, decode
from slamcli.mapping.mapper import Mapper
from slamcli.simulation import floors as floors_of_simulation
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions

FRAMES = Path(__file__).resolve().parent.parent / "samples" / "course" / "frames"
WRONG_LEVELS = 8
WRONG_SHARE = 0.02
SIZE = (640, 480)
CAMERA = CameraOptions(size=(320, 240), height_metres=0.2, pitch_degrees=45.0)
STEP_METRES = 0.03
Picture = NDArray[np.uint8]
Encoder = Callable[[Picture], bytes]


def pillow(kind: str, mode: str = "RGB", **options: object) -> Encoder:
    """Return an encoder of Pillow."""

    def encode(image: Picture) -> bytes:
        stream = io.BytesIO()
        Image.fromarray(image[..., ::-1]).convert(mode).save(stream, kind, **options)
        return stream.getvalue()

    return encode


def opencv(suffix: str, *parameters: int, gray: bool = False) -> Encoder:
    """Return an encoder of OpenCV."""

    def encode(image: Picture) -> bytes:
        pixels = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if gray else image
        return cv2.imencode(suffix, pixels, parameters)[1].tobytes()

    return encode


def encoders(kind: str) -> dict[str, Encoder]:
    """Return the encoders of a format, by name."""
    quality = (30, 75, 92, 98)
    if kind == "JPEG":
        found: dict[str, Encoder] = {}
        for q in quality:
            found |= {
                f"pillow {q}": pillow("JPEG", quality=q),
                f"pillow optimised {q}": pillow("JPEG", quality=q, optimize=True),
                f"pillow progressive {q}": pillow("JPEG", quality=q, progressive=True),
                f"pillow restarts {q}": pillow("JPEG", quality=q, restart_marker_rows=1),
                f"pillow whole colour {q}": pillow("JPEG", quality=q, subsampling=0),
                f"pillow gray {q}": pillow("JPEG", "L", quality=q),
                f"pillow inks {q}": pillow("JPEG", "CMYK", quality=q),
                f"opencv {q}": opencv(".jpg", cv2.IMWRITE_JPEG_QUALITY, q),
                f"opencv progressive {q}": opencv(
                    ".jpg", cv2.IMWRITE_JPEG_QUALITY, q, cv2.IMWRITE_JPEG_PROGRESSIVE, 1
                ),
                f"opencv restarts {q}": opencv(
                    ".jpg", cv2.IMWRITE_JPEG_QUALITY, q, cv2.IMWRITE_JPEG_RST_INTERVAL, 7
                ),
                f"simplejpeg {q}": lambda image, q=q: simplejpeg.encode_jpeg(
                    np.ascontiguousarray(image), q, "BGR", "420"
                ),
            }
        return found
    if kind == "WebP":
        found = {
            f"pillow method {method} {q}": pillow("WEBP", quality=q, method=method)
            for q in quality
            for method in (0, 4, 6)
        }
        found["pillow lossless"] = pillow("WEBP", lossless=True)
        found["opencv"] = opencv(".webp", cv2.IMWRITE_WEBP_QUALITY, 80)
        return found
    if kind == "PNG":
        return {
            "pillow": pillow("PNG"),
            "pillow gray": pillow("PNG", "L"),
            "opencv": opencv(".png"),
            "opencv gray": opencv(".png", gray=True),
        }
    if kind in PLAIN:
        return {
            f"{name} {mode}": encode(mode)
            for name, encode in PLAIN[kind].items()
            for mode in ("RGB", "L")
        }
    return {
        "pillow deflate": pillow("TIFF", compression="tiff_adobe_deflate"),
        "pillow lzw": pillow("TIFF", compression="tiff_lzw"),
        "pillow packbits": pillow("TIFF", compression="packbits"),
        "opencv": opencv(".tif"),
    }


# Without compression, and so without any check.
PLAIN: dict[str, dict[str, Callable[[str], Encoder]]] = {
    "TIFF, not compressed": {
        "pillow": lambda mode: pillow("TIFF", mode),
        "opencv": lambda mode: opencv(".tif", cv2.IMWRITE_TIFF_COMPRESSION, 1, gray=mode == "L"),
    },
    "BMP": {
        "pillow": lambda mode: pillow("BMP", mode),
        "opencv": lambda mode: opencv(".bmp", gray=mode == "L"),
    },
    "PNM": {"opencv": lambda mode: opencv(".pnm", gray=mode == "L")},
}
KINDS = ("JPEG", "WebP", "PNG", "TIFF", *PLAIN)


def floors(folder: Path) -> list[Picture]:
    """Return pictures of textured floors."""
    paths = sorted(path for path in folder.iterdir() if path.suffix in {".jpg", ".png"})
    frames = [cv2.imread(str(path)) for path in paths[:: max(1, len(paths) // 12)]]
    return [np.asarray(cv2.resize(frame, SIZE), np.uint8) for frame in frames] + [texture()]


def texture() -> Picture:
    """Return a floor of noise of four grain sizes."""
    rng = np.random.default_rng(3)
    image = np.full((SIZE[1], SIZE[0], 3), 128.0)
    for cell, levels in ((40, 30), (10, 20), (4, 10), (1, 3)):
        noise = rng.normal(0, levels, (SIZE[1] // cell, SIZE[0] // cell, 3))
        image += cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 0, 255).astype(np.uint8)


def plain_floors() -> list[Picture]:
    """Return black, painted, half empty and drawn floors."""
    black = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    rng = np.random.default_rng(5)
    pictures = [black + np.uint8(gray) for gray in (0, 16, 90, 128, 200, 255)]
    for rows in (slice(0, 240), slice(240, 480), slice(100, 130)):
        pictures.append(black + np.uint8(60))
        pictures[-1][rows] = texture()[rows]
    ramp = np.linspace(255, 0, SIZE[0]).astype(np.uint8)
    pictures.append(np.tile(ramp[None, :, None], (SIZE[1], 1, 3)))
    pictures.append(np.tile(np.uint8([180, 40, 10]), (SIZE[1], SIZE[0], 1)))
    for spacing in (17, 64):
        pictures.append(black + np.uint8(120))
        pictures[-1][::spacing], pictures[-1][:, ::spacing] = 230, 230
    pictures.append(black.copy())
    for _ in range(12):
        start, end = rng.integers(0, 480, (2, 2)).tolist()
        cv2.line(pictures[-1], start, end, (255, 255, 255), 9)
    pictures.append(np.where(np.indices(SIZE[::-1]).sum(0)[..., None] // 8 % 2, 255, black))
    pictures.append(texture() // 40)
    for value in (0, 255):
        pictures += bordered(value)
    pictures.append(rng.integers(0, 256, black.shape, dtype=np.uint8))
    return [np.asarray(picture, np.uint8) for picture in pictures]


def bordered(value: int) -> list[Picture]:
    """Return floors with borders of a gray, level and tilted ones, and with joints of it."""
    found = []
    columns = np.arange(SIZE[0])
    for rise in (0, 0.7, 1.0, 1.5, 3.0, 40.0):
        edge = columns * rise / SIZE[0]
        for smooth in (False, True):
            # The share of each pixel that lies within a joint 30 rows high, or in the lower border.
            rows = np.arange(SIZE[1])[:, None]
            joint = np.clip(rows + 1.0 - (200.4 + edge), 0, 1) - np.clip(
                rows + 1.0 - (230.4 + edge), 0, 1
            )
            border = np.clip(rows + 1.0 - (400.4 + edge), 0, 1)
            for share in (joint, border, np.maximum(border, border[::-1])):
                inside = (share if smooth else np.round(share))[..., None]
                across = np.zeros((1, SIZE[0], 1))
                across[:, 300:306] = 1.0
                inside = np.maximum(inside, across)
                found.append(np.round(texture() * (1 - inside) + value * inside).astype(np.uint8))
    return found


def damage(data: bytes, way: str, rng: np.random.Generator) -> bytes:
    """Return a damaged copy; its start, where most formats have the header, is kept."""
    first = min(700, len(data) // 4)
    changed = bytearray(data)
    length = int((len(data) - first) * (rng.uniform(0.02, 0.3)))
    start = int(rng.integers(first, len(data) - length - 12))
    if way == "zeroed":
        changed[start : start + length] = bytes(length)
    elif way == "erased":
        changed[start : start + length] = b"\xff" * length
    elif way == "cut, end put back":
        end = data[-2:] if data.startswith(b"\xff\xd8") else data[-12:]
        changed = bytearray(data[: len(data) - length - 12] + end)
    elif way == "half written":
        changed = bytearray(data[: len(data) - length] + bytes(length))
    else:
        changed[start] ^= 1 << int(rng.integers(8))
    return bytes(changed)


WAYS = ("zeroed", "erased", "cut, end put back", "half written", "one bit")


def wrong_share(damaged: bytes, whole: Picture) -> float:
    """Return the share of pixels that a decoder without checks gets wrong."""
    image = cv2.imdecode(np.frombuffer(damaged, np.uint8), cv2.IMREAD_COLOR_BGR)
    if image is None or image.shape != whole.shape:
        return 1.0
    return float(np.mean(cv2.absdiff(image, whole).max(axis=2) > WRONG_LEVELS))


def reason(data: bytes) -> str:
    """Return why a picture is refused, empty when it is read."""
    try:
        decode(data, Reading())
    except FrameError as error:
        return str(error)
    return ""


def noticed(kind: str, way: str, pictures: list[Picture], each: int, seed: int) -> list[object]:
    """Return a row: format, damage, tried, wrong ones, noticed among them and among the others."""
    rng = np.random.default_rng(seed)
    makers = list(encoders(kind).items())
    wrong, caught, others, others_caught = 0, 0, 0, 0
    missed: Counter[str] = Counter()
    for number in range(each):
        name, encode = makers[number % len(makers)]
        data = encode(pictures[int(rng.integers(len(pictures)))])
        whole = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_BGR))
        damaged = damage(data, way, rng)
        is_wrong = wrong_share(damaged, whole) > WRONG_SHARE
        is_caught = bool(reason(damaged))
        wrong, caught = wrong + is_wrong, caught + (is_wrong and is_caught)
        others, others_caught = (
            others + (not is_wrong),
            others_caught + (not is_wrong and is_caught),
        )
        missed[name] += is_wrong and not is_caught
    share = f"{caught / wrong:.1%}" if wrong else ""
    names = ", ".join(f"{name} {count}" for name, count in missed.items() if count)
    return [kind, way, each, wrong, caught, share, f"{others_caught} of {others}", names]


def good(pictures: list[Picture], count: int) -> Iterator[tuple[str, str]]:
    """Yield the encoder and the reason of each of so many good pictures; empty is right."""
    makers = [item for kind in KINDS for item in encoders(kind).items()]
    for number in range(count):
        name, encode = makers[number % len(makers)]
        yield name, reason(encode(pictures[number // len(makers) % len(pictures)]))


def milliseconds(works: list[Callable[[], object]], count: int = 25) -> list[str]:
    """Return the least time of some tries of each, by turns, as the machine is never quiet."""
    least = [float("inf")] * len(works)
    for _ in range(count):
        for number, work in enumerate(works):
            start = time.perf_counter()
            work()
            least[number] = min(least[number], time.perf_counter() - start)
    return [f"{1e3 * seconds:.1f}" for seconds in least]


def times(folder: Path) -> Iterator[list[object]]:
    """Yield the time of bare OpenCV and of the reader for a 1080p frame, format by format."""
    frame = cv2.resize(floors(folder)[0], (1920, 1080), interpolation=cv2.INTER_CUBIC)
    for kind, encode in (
        ("JPEG", pillow("JPEG", quality=92)),
        ("progressive JPEG", pillow("JPEG", quality=92, progressive=True)),
        ("WebP", pillow("WEBP", quality=80)),
        ("PNG", opencv(".png")),
        ("TIFF", pillow("TIFF", compression="tiff_lzw")),
    ):
        data = encode(np.asarray(frame, np.uint8))
        for gray, flag in ((True, cv2.IMREAD_GRAYSCALE), (False, cv2.IMREAD_COLOR_BGR)):
            yield [
                kind,
                "gray" if gray else "colour",
                *milliseconds(
                    [
                        lambda data=data, flag=flag: cv2.imdecode(
                            np.frombuffer(data, np.uint8), flag
                        ),
                        lambda data=data, gray=gray: decode(data, Reading(gray)),
                    ]
                ),
            ]


def placed(kind: str, encode: Encoder, way: str, count: int = 60) -> list[object]:
    """Return a row: how far frames with unnoticed damage are from where the undamaged ones are."""
    floor = floors_of_simulation.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3)
    photographer = photograph.Photographer(photograph.World(floor), photograph.make_camera(CAMERA))
    files = []
    for number in range(count):
        pose = Pose2(STEP_METRES * number)
        noise = np.random.default_rng(number)
        image = photograph.take(photographer, (pose, pose), 0.0, DisturbanceOptions(), noise)
        files.append(encode(image))
    rng = np.random.default_rng(5)
    damaged = {
        number: found
        for number in range(2, count, 3)
        if (found := unnoticed(files[number], way, rng)) is not None
    }
    undamaged, others = (
        located(photographer, [changes.get(number, data) for number, data in enumerate(files)])
        for changes in ({}, damaged)
    )
    errors = [
        math.dist((here.x, here.y), (there.x, there.y))
        for number in damaged
        if (here := undamaged[number]) is not None and (there := others[number]) is not None
    ]
    return [kind, way, len(damaged), len(errors), f"{1e3 * max(errors, default=0):.2f}"]


def unnoticed(data: bytes, way: str, rng: np.random.Generator) -> bytes | None:
    """Return a file of which over two percent are wrong, and nothing notices it."""
    whole = decode(data, Reading())[0]
    for _ in range(40):
        changed = damage(data, way, rng)
        if wrong_share(changed, whole) > WRONG_SHARE and not reason(changed):
            return changed
    return None


def located(photographer: photograph.Photographer, files: list[bytes]) -> list[Pose2 | None]:
    """Return the poses of a drive."""
    mapper = Mapper(photographer.calibration)
    for number, data in enumerate(files):
        mapper.update(Frame(number, str(number), None, *decode(data, Reading())))
    return [estimate.map_from_robot for estimate in mapper.finish()]


def row(cells: list[object]) -> None:
    """Print a row of a table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--each", type=int, default=150, help="damaged pictures a row")
    parser.add_argument(
        "--kind", choices=("", *KINDS), default="", help="of damaged pictures alone"
    )
    parser.add_argument("--good", type=int, default=1000, help="good pictures")
    parser.add_argument("--folder", type=Path, default=FRAMES, help="frames to encode")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    row(
        ["format", "damage", "tried", "> 2 % wrong", "noticed", "share", "others noticed", "missed"]
    )
    pictures = floors(arguments.folder)
    seed = 0
    for kind in KINDS:
        for way in WAYS:
            seed += 1
            if arguments.kind not in {"", kind}:
                continue
            row(noticed(kind, way, pictures, arguments.each, seed))
    alarms = [found for found in good(pictures + plain_floors(), arguments.good) if found[1]]
    print(f"false alarms on {arguments.good} good pictures: {len(alarms)}")
    for alarm in alarms[:20]:
        print(*alarm, sep=": ")
    row(["format", "damage", "unnoticed", "placed", "furthest off, mm"])
    for kind, encode, way in (
        ("JPEG", opencv(".jpg", cv2.IMWRITE_JPEG_QUALITY, 92), "one bit"),
        ("WebP", opencv(".webp", cv2.IMWRITE_WEBP_QUALITY, 90), "one bit"),
        ("BMP", opencv(".bmp"), "zeroed"),
        ("BMP", opencv(".bmp"), "half written"),
        ("BMP", opencv(".bmp"), "erased"),
        ("PNM", opencv(".ppm"), "zeroed"),
        ("PNM", opencv(".ppm"), "erased"),
        ("TIFF, not compressed", pillow("TIFF"), "zeroed"),
        ("TIFF, not compressed", pillow("TIFF"), "erased"),
        ("TIFF, not compressed", pillow("TIFF", "L"), "one bit"),
        ("TIFF", pillow("TIFF", compression="tiff_lzw"), "one bit"),
        ("TIFF", pillow("TIFF", compression="tiff_deflate"), "one bit"),
    ):
        row(placed(kind, encode, way))
    row(["1080p", "as", "bare OpenCV ms", "read ms"])
    for cells in times(arguments.folder):
        row(cells)


if __name__ == "__main__":
    main()
