"""camera_info: the lens and sensor of a camera, in YAML as ROS, OpenCV and their tools write it.

Read are the files of ROS camera_calibration and of camera_info_manager, what ``ros2 topic echo``
(or ``rostopic echo``) prints of a camera_info topic, and OpenCV's FileStorage. They differ in their
keys, in the case of these, and in which distortion models they name.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from slamcli.core.bounds import quoted
from slamcli.core.errors import CalibrationError, InputError
from slamcli.io.checks import FieldError, check_array
from slamcli.io.files import read_text

# PyYAML's own, and those of Python that its constructors let through, for tags and nesting.
_YAML_ERRORS = (
    yaml.YAMLError,
    ValueError,
    LookupError,
    AttributeError,
    TypeError,
    ArithmeticError,
    RecursionError,
)
# OpenCV's first line, which is no directive of YAML.
_OPENCV_DIRECTIVE = re.compile(r"\A\ufeff?%YAML:1\.0[^\n]*\n")
# The distortion models by all their names: those of ROS, its drivers, Kalibr and OpenCV.
_MODELS = {
    "": None,
    "none": None,
    "pinhole": None,
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "rational": "rational_polynomial",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "kannala_brandt4": "equidistant",
}
# The same field by the key of a message (both of ROS 1 and 2, in lower case) and of a file.
_KEYS = {
    "image_width": ("image_width", "width"),
    "image_height": ("image_height", "height"),
    "camera_matrix": ("camera_matrix", "k"),
    "distortion_coefficients": ("distortion_coefficients", "d"),
}
# Coefficients after those of a model, of the thin prism and the tilted sensor, when they are zero.
_LONGEST_DISTORTION = 14
_RATIONAL_COUNT = 8


class _Loader(yaml.SafeLoader):
    """YAML 1.1 as PyYAML reads it, with the numbers of YAML 1.2 and OpenCV's matrices."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9]+|[0-9]*\.[0-9]+|[0-9]+\.[0-9]*)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            problem="not a matrix", problem_mark=node.start_mark
        )
    return dict(loader.construct_mapping(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_document(path: Path, what: str) -> dict[str, Any]:
    """Return the first document of a YAML file.

    Raises
    ------
    CalibrationError
        One line that names the file and, where it is known, the line.
    """
    try:
        text = _OPENCV_DIRECTIVE.sub("", read_text(path, what))
        # What a topic's echo prints ends in the mark of a further document.
        document = next(iter(yaml.load_all(text, _Loader)), None)
    except InputError as error:
        raise CalibrationError(str(error)) from error
    except _YAML_ERRORS as error:
        mark = getattr(error, "problem_mark", None)
        where = f" (line {mark.line + 1})" if mark is not None else ""
        raise CalibrationError(f"{path}: not a {what} file: it is not YAML{where}") from error
    if not isinstance(document, dict):
        raise CalibrationError(f"{path}: not a {what} file: no keys such as camera_matrix in it")
    return document


def intrinsics_section(document: dict[str, Any]) -> dict[str, Any]:
    """Return lens and sensor of a document by the names of `calibration_codec`.

    Raises
    ------
    FieldError
        When a key is missing, two contradict each other, or the picture is binned or cropped.
    """
    fields = _lower_case(document)
    _check_whole(fields)
    matrix = _matrix_data(_value(fields, "camera_matrix"), "camera_matrix")
    section = {
        "image_size": [_side(fields, key) for key in ("image_width", "image_height")],
        "camera_matrix": matrix,
    }
    given = _value(fields, "distortion_coefficients", required=False)
    distortion = [] if given is None else _matrix_data(given, "distortion_coefficients")
    model = _model(fields)
    if isinstance(distortion, list) and len(distortion) > 0:
        distortion, model = _distortion(distortion, model)
        section["distortion"] = distortion
    section["distortion_model"] = model or "plumb_bob"
    return section


def number(section: dict[str, Any], key: str, default: float | None = None) -> float:
    """Return a number of a section; without a default it must be there. Raises FieldError."""
    if default is None and key not in section:
        raise FieldError(key, "is missing")
    value = section.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldError(key, f"is {quoted(value)}, not a number")
    try:
        return float(value)
    except OverflowError as error:
        raise FieldError(key, "is too large") from error


def matrix_data(section: dict[str, Any], key: str) -> Any:
    """Return the numbers of a matrix in camera_info's form, or as plain lists."""
    if key not in section:
        raise FieldError(key, "is missing")
    return _matrix_data(section[key], key)


def _matrix_data(value: Any, key: str) -> Any:
    if isinstance(value, dict):
        if "data" not in value:
            raise FieldError(key, "has no data")
        return value["data"]
    return value


def _lower_case(document: dict[str, Any]) -> dict[str, Any]:
    """Return the fields by their keys in lower case: K and image_Width are k and image_width."""
    fields: dict[str, Any] = {}
    for key, value in document.items():
        name = str(key).lower()
        if name in fields and fields[name] != value:
            raise FieldError(name, "is given twice, and not alike; leave one out")
        fields[name] = value
    return fields


def _value(fields: dict[str, Any], key: str, *, required: bool = True) -> Any:
    """Return a field by either of its keys, which must agree where both are given."""
    names = [name for name in _KEYS[key] if name in fields]
    if not names:
        if required:
            raise FieldError(key, "is missing")
        return None
    values = [_matrix_data(fields[name], name) for name in names]
    if any(value != values[0] for value in values):
        raise FieldError(key, f"and {names[1]} contradict each other; leave one out")
    return values[0]


def _side(fields: dict[str, Any], key: str) -> float:
    return number({key: _value(fields, key)}, key)


def _check_whole(fields: dict[str, Any]) -> None:
    """Refuse a message on a part of the sensor's picture, or on one of fewer pixels."""
    roi = fields.get("roi")
    offsets = [roi.get(key) for key in ("x_offset", "y_offset")] if isinstance(roi, dict) else []
    binning = [fields.get(key) for key in ("binning_x", "binning_y")]
    if any(offset not in (0, None) for offset in offsets):
        raise FieldError("roi", "is a part of the picture; the camera_info of whole ones is needed")
    if any(count not in (0, 1, None) for count in binning):
        raise FieldError("binning_x", "is not 1; the camera_info of unbinned pictures is needed")


def _model(fields: dict[str, Any]) -> str | None:
    """Return the distortion model by our name for it; None where none is named."""
    models: dict[str, str] = {}
    for key in ("distortion_model", "camera_model"):
        word = str(fields.get(key) or "").strip().lower().replace("-", "_").replace(" ", "_")
        if word not in _MODELS:
            known = ", ".join(sorted(name for name in _MODELS if name))
            raise FieldError(key, f"is {quoted(fields[key])}, not one of {known}")
        model = _MODELS[word]
        if model is not None:
            models[key] = model
    if fields.get("fisheye_model") in (1, True):
        models["fisheye_model"] = "equidistant"
    if len(set(models.values())) > 1:
        (first, one), (second, other) = list(models.items())[:2]
        raise FieldError(
            first, f"({one}) and {second} ({other}) contradict each other; leave one out"
        )
    return next(iter(models.values()), None)


def _distortion(given: list[Any], model: str | None) -> tuple[list[float], str | None]:
    """Return coefficients without the zeros after those of their model, and the model."""
    numbers = check_array(given, "distortion_coefficients").ravel().tolist()
    if model is None and len(numbers) >= _RATIONAL_COUNT:
        model = "rational_polynomial"
    counts = {"rational_polynomial": _RATIONAL_COUNT, "equidistant": 4}
    count = counts.get(model or "plumb_bob", 5)
    if count < len(numbers) <= _LONGEST_DISTORTION and not any(numbers[count:]):
        numbers = numbers[:count]
    return numbers, model
