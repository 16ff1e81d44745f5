"""Descriptions of actions of ROS for agents: the parameters of a goal, with their types and ranges."""

from __future__ import annotations

from typing import Any

from rosidl_parser import definition as idl

from fipa.ros2 import values
from fipa.ros2.mapping import Settings

#: Maximum number of goals of an action that run at the same time. The server of ROS decides about each.
CONCURRENCY = 64


def action(name: str, kind: Any, settings: Settings) -> dict[str, Any]:
    """Describes an action as `Agent.goals` reads it. The server of ROS accepts or rejects each goal."""
    described: dict[str, Any] = {
        "name": name,
        "parameters": [parameter(*field) for field in values.fields(kind.Goal)],
        "result": "any",
        "concurrency": CONCURRENCY,
        "client_gone": settings.client_gone,
        "decides": True,
    }
    if settings.fenced_by is not None:
        owner, resource = settings.fenced_by
        described["fenced_by"] = {"owner": owner, "resource": resource}
    return described


def parameter(name: str, kind: Any) -> dict[str, Any]:
    described: dict[str, Any] = {"name": name, "type": type_of(kind), "optional": True}
    bounds = values.integer_range(kind)
    # A greater range has no exact bounds as floating-point numbers; the bridge checks it.
    if bounds is not None and bounds[1] < 2**53:
        described["range"] = {"min": float(bounds[0]), "max": float(bounds[1])}
    return described


def type_of(kind: Any) -> Any:
    if values.is_bytes(kind):
        return "any"
    if isinstance(kind, idl.AbstractNestedType):
        return {"list": {"of": type_of(kind.value_type)}}
    if values.integer_range(kind) is not None:
        return "integer"
    if isinstance(kind, idl.BasicType):
        # NaN and infinities are texts.
        return "boolean" if kind.typename == "boolean" else "any"
    return "any" if isinstance(kind, idl.NamespacedType) else "string"
