"""ROS messages as values of JSON, and back.

| ROS | JSON |
|---|---|
| `bool` | `true`, `false` |
| integers, `char`, `byte` | integers, exactly, also beyond 2^53 |
| `float32`, `float64` | numbers; NaN and infinities are `"NaN"`, `"Infinity"` and `"-Infinity"` |
| `string`, `wstring` | texts |
| `uint8[]`, `byte[]` | a text in base64; a list of integers is read, too |
| other arrays and sequences | lists |
| messages | objects, in which a field that is missing has its default |
"""

from __future__ import annotations

import base64
import binascii
import functools
import importlib
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

from rosidl_parser import definition as idl

import fipa
from fipa import sl

#: Maximum number of elements of a list in JSON.
MAX_ELEMENTS = 100_000

_NUMBERS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_FLOATS = {"float", "double", "long double"}
_BYTES = {"octet", "uint8"}
_INTEGERS = {
    **{name: (0, 2**8 - 1) for name in ("octet", "char")},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
}


class UnknownType(LookupError):
    """A type whose package is not in the environment."""


@functools.cache
def load(name: str) -> Any:
    """Returns the class of a type: `std_msgs/msg/String`, `test_msgs/action/Fibonacci`. Raises `UnknownType`."""
    parts = name.split("/")
    if len(parts) != 3 or not all(part.isidentifier() for part in parts):
        raise UnknownType(f"{name!r} is no type: expected PACKAGE/msg/NAME, PACKAGE/srv/NAME or PACKAGE/action/NAME")
    package, kind, word = parts
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), word)
    except ModuleNotFoundError:
        raise UnknownType(f"the type {name} is unknown: source the workspace with the package {package}") from None
    except AttributeError:
        raise UnknownType(
            f"the package {package} has no {kind} {word}: source a workspace whose {package} has it"
        ) from None


def name_of(kind: Any) -> str:
    """The name of a message type: `std_msgs/msg/String`."""
    package, _, word = kind.__module__.partition(".")
    return f"{package}/{word.split('.')[0]}/{kind.__name__}"


class TooLarge(ValueError):
    """A message that is too large for JSON."""


class Mismatch(ValueError):
    """A value that a ROS type does not have: `pose.position.x: expected a number, got "left"`."""

    def __init__(self, path: str, expected: str, value: object) -> None:
        shown = repr(value)
        shown = shown if len(shown) <= 80 else shown[:80] + "…"
        super().__init__(f"{path or 'the message'}: expected {expected}, got {shown}")


def fields(message_type: Any) -> Iterable[tuple[str, Any]]:
    """The names and types of the fields of a message. An empty message has one that only IDL needs."""
    names = message_type.get_fields_and_field_types()
    pairs = zip(names, message_type.SLOT_TYPES, strict=True)
    return ((name, kind) for name, kind in pairs if name != "structure_needs_at_least_one_member")


def integer_range(kind: Any) -> tuple[int, int] | None:
    """The least and the greatest integer of a type; `None` for other types."""
    return _INTEGERS.get(kind.typename) if isinstance(kind, idl.BasicType) else None


def is_bytes(kind: Any) -> bool:
    return isinstance(kind, idl.AbstractNestedType) and getattr(kind.value_type, "typename", None) in _BYTES


def content(letter: fipa.Letter) -> Any:
    """Reads the content of a letter, in JSON or SL. Raises `ValueError`, `RecursionError` and `fipa.Error`."""
    return json.loads(letter.text) if letter.language == "json" else sl.loads(letter.text)


def to_json(message: Any) -> dict[str, Any]:
    """Writes a message. Raises `TooLarge`."""
    return {name: _write(getattr(message, name), kind) for name, kind in fields(type(message))}


def _write(value: Any, kind: Any) -> Any:
    if isinstance(kind, idl.AbstractNestedType):
        if is_bytes(kind):
            joined = b"".join(value) if getattr(kind.value_type, "typename", None) == "octet" else bytes(value)
            return base64.b64encode(joined).decode()
        if len(value) > MAX_ELEMENTS:
            raise TooLarge(f"a list of {len(value)} elements is too large for JSON, which holds {MAX_ELEMENTS}")
        return [_write(element, kind.value_type) for element in value]
    if isinstance(kind, idl.NamespacedType):
        return to_json(value)
    if isinstance(kind, idl.BasicType):
        if kind.typename == "octet":
            return value[0]
        if kind.typename in _FLOATS:
            return _float(float(value))
        return bool(value) if kind.typename == "boolean" else int(value)
    return str(value)


def _float(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def from_json(message_type: Any, value: Any, path: str = "") -> Any:
    """Reads a message of this type. Raises `Mismatch`."""
    if not isinstance(value, dict):
        raise Mismatch(path, "an object", value)
    message = message_type()
    known = dict(fields(message_type))
    for name, part in value.items():
        word = name if name.isidentifier() else repr(name)
        at = f"{path}.{word}" if path else word
        if name not in known:
            raise Mismatch(at, f"a field of {', '.join(known) or 'none'}", name)
        setattr(message, name, _read(part, known[name], at))
    return message


def _read(value: Any, kind: Any, path: str) -> Any:
    if isinstance(kind, idl.AbstractNestedType):
        return _read_elements(value, kind, path)
    if isinstance(kind, idl.NamespacedType):
        return from_json(load("/".join(kind.namespaced_name())), value, path)
    if isinstance(kind, idl.BasicType):
        return _read_basic(value, kind.typename, path)
    if not isinstance(value, str):
        raise Mismatch(path, "a text", value)
    bound = getattr(kind, "maximum_size", None)
    if bound is not None and len(value) > bound:
        raise Mismatch(path, f"a text of at most {bound} characters", value)
    return value


def _read_basic(value: Any, name: str, path: str) -> Any:
    if name == "boolean":
        if not isinstance(value, bool):
            raise Mismatch(path, "true or false", value)
        return value
    if name in _FLOATS:
        if isinstance(value, str) and value in _NUMBERS:
            return _NUMBERS[value]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise Mismatch(path, "a number", value)
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number) or (name == "float" and abs(number) > 3.4028234663852886e38):
            raise Mismatch(path, f"a finite number of the type {name}", value)
        return number
    least, greatest = _INTEGERS[name]
    is_whole = isinstance(value, float) and value.is_integer()
    if isinstance(value, bool) or not (isinstance(value, int) or is_whole) or not least <= value <= greatest:
        raise Mismatch(path, f"an integer from {least} to {greatest}", value)
    return bytes([int(value)]) if name == "octet" else int(value)


def _read_elements(value: Any, kind: Any, path: str) -> Any:
    if is_bytes(kind) and isinstance(value, str):
        try:
            value = list(base64.b64decode(value, validate=True))
        except binascii.Error:
            raise Mismatch(path, "a text in base64", value) from None
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise Mismatch(path, "a list", value)
    if isinstance(kind, idl.Array) and len(value) != kind.size:
        raise Mismatch(path, f"a list of {kind.size} elements", value)
    if isinstance(kind, idl.BoundedSequence) and len(value) > kind.maximum_size:
        raise Mismatch(path, f"a list of at most {kind.maximum_size} elements", value)
    return [_read(element, kind.value_type, f"{path}[{index}]") for index, element in enumerate(value)]
