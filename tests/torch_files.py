"""Weights as PyTorch writes them, without PyTorch: a ZIP of the tensors and of a pickle."""

from __future__ import annotations

import io
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np


class _Pickler(pickle.Pickler):
    """A pickler that puts arrays into storages of their own."""

    def __init__(self, file: io.BytesIO, torch: types.ModuleType) -> None:
        super().__init__(file, protocol=2)
        self.arrays: list[np.ndarray] = []
        self._torch = torch

    def persistent_id(self, obj: Any) -> Any:
        if not isinstance(obj, _Storage):
            return None
        self.arrays.append(obj.array)
        key = str(len(self.arrays) - 1)
        return ("storage", self._torch.FloatStorage, key, "cpu", obj.array.size)

    def reducer_override(self, obj: Any) -> Any:
        if not isinstance(obj, np.ndarray):
            return NotImplemented
        strides = tuple(stride // obj.itemsize for stride in obj.strides)
        arguments = (_Storage(obj), 0, obj.shape, strides, False, OrderedDict())
        return self._torch._utils._rebuild_tensor_v2, arguments


class _Storage:
    def __init__(self, array: np.ndarray) -> None:
        self.array = array


def write_weights(path: Path, tensors: dict[str, np.ndarray], member: str | None = None) -> Path:
    """Write float32 tensors; with a member's name, into a wheel."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    torch._utils = utils  # type: ignore[attr-defined]
    torch.FloatStorage = type("FloatStorage", (), {"__module__": "torch"})  # type: ignore[attr-defined]

    def _rebuild_tensor_v2() -> None: ...

    _rebuild_tensor_v2.__module__ = "torch._utils"
    _rebuild_tensor_v2.__qualname__ = "_rebuild_tensor_v2"
    utils._rebuild_tensor_v2 = _rebuild_tensor_v2  # type: ignore[attr-defined]
    pickled = io.BytesIO()
    pickler = _Pickler(pickled, torch)
    before = {name: sys.modules.get(name) for name in ("torch", "torch._utils")}
    sys.modules.update({"torch": torch, "torch._utils": utils})
    try:
        pickler.dump(OrderedDict(tensors))
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("archive/data.pkl", pickled.getvalue())
        for number, array in enumerate(pickler.arrays):
            archive.writestr(f"archive/data/{number}", array.astype("<f4").tobytes())
    if member is None:
        path.write_bytes(content.getvalue())
        return path
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr(member, content.getvalue())
    return path
