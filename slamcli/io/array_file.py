"""A file of named arrays and a header, which is never executed: only numbers and text are read.

A line of text that names its kind; the SHA-256 of all that follows; the length of a JSON header;
the header, with each array's type and shape; and the arrays, little-endian, one after another.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.arrays import AnyArray
from slamcli.core.errors import InputError
from slamcli.io.files import fault_of_file, write_chunks

_DIGEST_BYTES, _LENGTH_BYTES = 32, 8
_MAX_BYTES = 16 * 2**30
_TYPES = frozenset({"|b1", "|u1", "<i8", "<f8"})


def write_arrays(
    path: Path, magic: bytes, header: Mapping[str, Any], arrays: Mapping[str, AnyArray]
) -> None:
    """Write a file whole or not at all; `read_arrays` returns the same.

    Parameters
    ----------
    magic : bytes
        The first line, which names the kind of file and its version.
    header : mapping
        What JSON can have.
    arrays : mapping
        Bools, bytes, and 64-bit integers and floating-point numbers.
    """
    listed = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
    text = json.dumps({"header": dict(header), "arrays": listed}).encode()
    chunks = [len(text).to_bytes(_LENGTH_BYTES, "little"), text]
    chunks += [array.tobytes() for array in arrays.values()]
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    write_chunks(path, [magic, digest.digest(), *chunks])


def read_arrays(path: Path, magic: bytes) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """Return a file's header and its arrays, which are read-only.

    Raises
    ------
    InputError
        Names the file, and what is wrong with it.
    """
    try:
        fault = fault_of_file(path, _MAX_BYTES)
        if fault:
            raise InputError(f"cannot read {path}: {fault}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    start = len(magic) + _DIGEST_BYTES
    if not data.startswith(magic) or len(data) < start + _LENGTH_BYTES:
        raise InputError(f"{path} is damaged: it does not begin as it should")
    body = memoryview(data)[start:]
    if hashlib.sha256(body).digest() != data[len(magic) : start]:
        raise InputError(f"{path} is damaged: its checksum differs")
    end = _LENGTH_BYTES + int.from_bytes(body[:_LENGTH_BYTES], "little")
    try:
        table = json.loads(bytes(body[_LENGTH_BYTES:end]))
        return dict(table["header"]), _cut(table["arrays"], body[end:])
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged: {' '.join(str(error).split())}") from error


def _cut(listed: Mapping[str, Any], data: memoryview) -> dict[str, AnyArray]:
    """Cut the arrays out of the data, which they must fill exactly; raises ValueError."""
    arrays: dict[str, AnyArray] = {}
    at = 0
    for name, (kind, shape) in listed.items():
        if kind not in _TYPES or not all(type(n) is int and 0 <= n <= len(data) for n in shape):
            raise ValueError(f"its {name} are {kind!r} of shape {shape}")
        count = math.prod(shape)
        arrays[name] = np.frombuffer(data, kind, count, at).reshape(shape)
        at += count * np.dtype(kind).itemsize
    if at != len(data):
        raise ValueError("it goes on after its end")
    return arrays
