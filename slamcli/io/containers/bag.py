"""ROS 1 and ROS 2 bags, read by rosbags without ROS: topics by their types, and their messages.

rosbags is imported here and nowhere else, and only for a bag.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import RLock
from typing import Any

from slamcli.core.errors import InputError, SlamcliError
from slamcli.io.containers.bag_compression import bound_decompression
from slamcli.io.files import fault_of_file

BAG_SUFFIXES = frozenset({".bag", ".db3", ".mcap"})
# What topics of pictures are called in messages.
IMAGES = "images"
_METADATA = "metadata.yaml"
_MAX_METADATA_BYTES, _MAX_BAG_BYTES = 64 * 2**20, 2**63
# What the files of bags begin with: rosbags would look for the end of a line in any other.
_STARTS = {".bag": b"#ROSBAG V", ".db3": b"SQLite format 3\0", ".mcap": b"\x89MCAP0\r\n"}
_MAX_SHOWN = 6


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file of one, or the folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / _METADATA).is_file() and any(
            not BAG_SUFFIXES.isdisjoint(one.suffixes) for one in path.iterdir()
        )
    return path.suffix.lower() in BAG_SUFFIXES


def _check_files(path: Path) -> None:
    """Raise InputError when a file of a bag is a pipe or a device, or begins as none does."""
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        start = _STARTS.get(file.suffix.lower(), b"")
        if not start and file.name != _METADATA:
            continue
        try:
            fault = fault_of_file(file, _MAX_BAG_BYTES if start else _MAX_METADATA_BYTES)
            if not fault:
                with file.open("rb") as stream:
                    if stream.read(len(start)) != start:
                        fault = f"it does not begin as a {file.suffix} file"
        except OSError as error:
            fault = error.strerror or str(error)
        if fault:
            raise InputError(f"cannot read the bag {file}: {fault}")


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a bag.

    Attributes
    ----------
    record_ns : int
        When it was recorded, nanoseconds since 1970.
    number : int
        Among the messages of its topic that were recorded at that time.
    content
        Its fields, named as in ROS.
    """

    record_ns: int
    number: int
    content: Any

    @property
    def stamp_ns(self) -> int:
        """When it was measured: the stamp of its header, or the time of recording without one."""
        header = getattr(self.content, "header", None)
        if header is None or (header.stamp.sec == 0 and header.stamp.nanosec == 0):
            return self.record_ns
        return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


class Bag:
    """An open bag; may be shared by threads. In another process it is opened anew.

    Parameters
    ----------
    path : Path
        A file, or the folder of a ROS 2 bag.

    Raises
    ------
    InputError
        At the first use: when rosbags is not installed, or the bag is damaged.
    """

    def __init__(self, path: Path) -> None:
        # Workers of a cluster run in folders of their own.
        self.path = path.absolute()
        self._lock = RLock()

    def __reduce__(self) -> tuple[object, ...]:
        return Bag, (self.path,)

    def topics(self, *kinds: str) -> dict[str, int]:
        """Return how many messages each topic of some message types has, by name."""
        with self._lock, self._refused():
            found: dict[str, int] = {}
            for one in self._reader.connections:
                if one.msgtype in kinds:
                    found[one.topic] = found.get(one.topic, 0) + one.msgcount
            return dict(sorted(found.items()))

    def kind(self, topic: str) -> str:
        """Return the message type of a topic."""
        with self._lock, self._refused():
            return str(next(c.msgtype for c in self._reader.connections if c.topic == topic))

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of a topic that were recorded in a time, in that order.

        Raises
        ------
        InputError
        """
        with self._lock, self._refused():
            reader = self._reader
            chosen = [one for one in reader.connections if one.topic == topic]
            before, number = None, 0
            for connection, record_ns, data in reader.messages(chosen, start_ns, stop_ns):
                number = number + 1 if record_ns == before else 0
                before = record_ns
                content = reader.deserialize(data, connection.msgtype)
                yield Message(record_ns, number, content)

    def message(self, topic: str, record_ns: int, number: int) -> Message:
        """Return one message of a topic; raises InputError."""
        for found in self.messages(topic, record_ns, record_ns + 1):
            if found.number == number:
                return found
        raise InputError(f"{self.path} has changed since it was read first")

    def choose(self, what: str, topics: dict[str, int], named: str = "") -> str:
        """Return the topic that is named, or the only one.

        Raises
        ------
        InputError
            When there is none, or there are several and none is named.
        """
        if named in topics:
            return named
        shown = [f"{topic} ({count})" for topic, count in topics.items()][:_MAX_SHOWN]
        listed = ", ".join(shown) or "none"
        if named:
            raise InputError(f"{self.path} has no topic {named} of {what}; it has {listed}")
        if not topics:
            raise InputError(f"{self.path} has no topic of {what}")
        if len(topics) > 1:
            how = "--topic NAME" if what == IMAGES else f"{self.path.name}:{next(iter(topics))}"
            raise InputError(f"{self.path} has {what} on {listed}; choose one, as {how}")
        return next(iter(topics))

    @property
    def span_ns(self) -> tuple[int, int]:
        """Time of the first message and after the last, of all topics."""
        with self._lock, self._refused():
            return int(self._reader.start_time), int(self._reader.end_time)

    @cached_property
    def _reader(self) -> Any:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise InputError(
                f"the bag {self.path} needs rosbags: pip install 'slamcli[rosbag]'"
            ) from error
        _check_files(self.path)
        bound_decompression()
        reader = AnyReader([self.path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
        weakref.finalize(self, reader.close)
        return reader

    @contextmanager
    def _refused(self) -> Iterator[None]:
        """Turn whatever the parsers raise on a damaged bag into an InputError."""
        try:
            yield
        except (SlamcliError, GeneratorExit):
            raise
        except Exception as error:
            # Of memory, too, when a length in a damaged bag is beyond all bounds.
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"cannot read the bag {self.path}: {reason}") from error
