"""The frames of a bag: one topic's pictures, chosen as those of a video are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import FrameSelection
from slamcli.core.errors import FrameError, InputError
from slamcli.io.containers import ros_image
from slamcli.io.containers.bag import IMAGES, Bag, Message
from slamcli.io.containers.choice import Candidate, Counts, choose
from slamcli.io.containers.part import Progress, silent
from slamcli.io.images.decoding import CAMERA_BITS, Reading, decode, from_pixels, picture_size

_IMAGES = ros_image.IMAGE, ros_image.COMPRESSED


@dataclass(frozen=True, slots=True)
class BagFrame:
    """A picture of a bag, not read yet: a `Part`.

    Attributes
    ----------
    bag : Bag
    topic : str
    record_ns, number : int
        Of its message.
    sample_bits : int
        The range of samples of 16 bits, the same for all frames.
    name : str
        Its stamp and the suffix of its format.
    stamp : float
        Seconds: of the message's header.
    size : (int, int)
        Width and height.
    note : str
        How many frames were chosen of how many.
    """

    bag: Bag
    topic: str
    record_ns: int
    number: int
    sample_bits: int
    name: str
    stamp: float
    size: tuple[int, int]
    note: str

    def content(self) -> bytes | UInt8Array:
        """Return the encoded picture, or its pixels; raises FrameError."""
        try:
            message = self.bag.message(self.topic, self.record_ns, self.number)
        except InputError as error:
            raise FrameError(f"cannot be read: {error}") from error
        return ros_image.picture(message.content, self.sample_bits)


@dataclass(frozen=True, slots=True)
class _Found:
    """Where a picture is, and what it is."""

    record_ns: int
    number: int
    name: str
    stamp: float
    size: tuple[int, int]


def bag_frames(
    path: Path, selection: FrameSelection, progress: Progress = silent
) -> list[BagFrame]:
    """Return the chosen pictures of a bag's topic, in the order of their stamps.

    Raises
    ------
    InputError
        When rosbags is not installed, the bag is damaged, or the topic is not determined.
    """
    bag = Bag(path)
    topic = image_topic(bag, selection.topic)
    counts, bits, faults = Counts(), [8], list[str]()
    candidates = partial(_candidates, bag, topic, counts, bits, faults, progress)
    found = [one.payload for one in choose(candidates(), selection, _step(bag, topic), counts)]
    if not found:
        why = f" ({faults[0]})" if faults else ""
        raise InputError(f"{path} has no frame that can be read in the part that was chosen{why}")
    used = next(depth for depth in CAMERA_BITS if max(bits) <= depth)
    note = counts.note(f"{path.name}, {topic}", len(found))
    return [
        BagFrame(bag, topic, one.record_ns, one.number, used, one.name, one.stamp, one.size, note)
        for one in sorted(found, key=lambda one: one.stamp)
    ]


def image_topic(bag: Bag, named: str) -> str:
    """Return the topic of pictures that is named, or the only one; raises InputError.

    Images of distances are none. Of a picture that is there twice the one without loss is taken.
    """
    topics = bag.topics(*_IMAGES)
    if named:
        return bag.choose(IMAGES, topics, named)
    firsts = {topic: next(bag.messages(topic), None) for topic in topics}
    seen = {
        topic: topics[topic]
        for topic, first in firsts.items()
        if first is not None and not ros_image.is_depth(first.content)
    }
    twice = [topic for topic in seen if topic.removesuffix("/compressed") in set(seen) - {topic}]
    return bag.choose(IMAGES, {t: n for t, n in seen.items() if t not in twice})


def _step(bag: Bag, topic: str) -> float:
    """Return the mean time between two messages of a topic, seconds."""
    count = bag.topics(*_IMAGES)[topic]
    first, last = bag.span_ns
    return (last - first) / 1e9 / max(1, count - 1)


def _candidates(
    bag: Bag,
    topic: str,
    counts: Counts,
    bits: list[int],
    faults: list[str],
    progress: Progress,
) -> Iterator[Candidate[_Found]]:
    """Yield the pictures of a topic that can be read; count all, and list the others' faults."""
    total = bag.topics(*_IMAGES)[topic]
    first: int | None = None
    for done, message in enumerate(bag.messages(topic), start=1):
        progress("reading bag", done, max(total, done))
        first = message.stamp_ns if first is None else first
        try:
            found, luma, used = _picture(message)
        except FrameError as error:
            faults.append(str(error))
            counts.all += 1
            counts.damaged += 1
            continue
        bits[0] = max(bits[0], used)
        yield Candidate((message.stamp_ns - first) / 1e9, luma, found)


def _picture(message: Message) -> tuple[_Found, UInt8Array, int]:
    """Return where a picture is, its luma, and the bits of its samples; raises FrameError."""
    used = ros_image.used_bits(message.content)
    content = ros_image.picture(message.content, used)
    if isinstance(content, bytes):
        size, suffix = picture_size(content), "jpg" if content.startswith(b"\xff\xd8") else "png"
        luma = decode(content, Reading(gray=True, factor=4))[0]
    else:
        size, suffix = (content.shape[1], content.shape[0]), "png"
        luma = from_pixels(content, Reading(gray=True))
    micros = message.stamp_ns // 1000
    name = f"{micros // 10**6}.{micros % 10**6:06d}"
    place = message.record_ns, message.number
    return _Found(*place, f"{name}.{suffix}", float(name), size), luma, used
