"""The types of messages, services and actions, from the packages that the environment has."""

from __future__ import annotations

import functools
import importlib
from typing import Any


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
