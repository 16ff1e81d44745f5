"""The mapping: which actions, services and topics of ROS are agents', and the other way round.

    # Of ROS, for agents. Names may be patterns: "/crex/*".
    actions = ["/crex/navigate"]
    services = ["/crex/set_speed"]
    topics = ["/crex/pose", "/crex/image"]

    # The agent of names without a namespace, such as /navigate.
    robot = "crex"

    [settings."/crex/image"]
    content = "cdr"                 # or "json", the default
    [settings."/crex/navigate"]
    client_gone = "continue"        # or "cancel", the default
    fenced_by = ["door", "passage"] # a goal needs the fence of a lock: owner and resource

    # Of agents, for ROS: the type of each.
    [agents.arm_1.actions]
    move = "arm_interfaces/action/Move"
    [agents.arm_1.services]
    lift = "std_srvs/srv/Trigger"
    [agents.arm_1.topics]
    temperature = "std_msgs/msg/Float64"
"""

from __future__ import annotations

import fnmatch
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


class WrongMapping(ValueError):
    """A file that is no mapping, with the place of the mistake."""


@dataclass(frozen=True)
class Settings:
    """What is set for names of ROS."""

    content: str = "json"
    client_gone: str = "cancel"
    #: The owner and the resource of the lock whose fence a goal needs.
    fenced_by: tuple[str, str] | None = None


@dataclass(frozen=True)
class Foreign:
    """What an agent offers to ROS: the names of the ROS types."""

    actions: dict[str, str] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)


#: The kinds of what ROS offers, as in the file.
KINDS = ("actions", "services", "topics")

#: A part of a name of ROS.
_WORD = re.compile("[A-Za-z_][A-Za-z0-9_]*")

_CHOICES = {"content": ("json", "cdr"), "client_gone": ("cancel", "continue")}


@dataclass(frozen=True)
class Mapping:
    """What the file names."""

    actions: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    robot: str | None = None
    settings: dict[str, Settings] = field(default_factory=dict)
    agents: dict[str, Foreign] = field(default_factory=dict)

    def maps(self, kind: str, name: str) -> bool:
        patterns: tuple[str, ...] = getattr(self, kind)
        return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)

    def of(self, name: str) -> Settings:
        """The settings of a name: those of the longest pattern that fits."""
        fitting = [pattern for pattern in self.settings if fnmatch.fnmatchcase(name, pattern)]
        return self.settings[max(fitting, key=len)] if fitting else Settings()

    def agent_of(self, name: str) -> tuple[str, str] | None:
        """The agent of a name of ROS, and its name there: `/crex/arm/move` is `move` of the agent `crex/arm`."""
        namespace, _, base = name.rpartition("/")
        agent = namespace.strip("/") or self.robot
        return (agent, base) if agent else None


def read(file: Path) -> Mapping:
    """Reads a mapping. Raises `WrongMapping` and `OSError`."""
    try:
        return _mapping(tomllib.loads(file.read_text()))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, WrongMapping) as error:
        raise WrongMapping(f"{file}: {error}") from None


def _mapping(text: dict[str, Any]) -> Mapping:
    _known(text, "", (*KINDS, "robot", "settings", "agents"))
    names = {kind: tuple(_names(text.get(kind, []), kind)) for kind in KINDS}
    robot = text.get("robot")
    if robot is not None and not isinstance(robot, str):
        raise WrongMapping(f"robot: expected the name of an agent, got {robot!r}")
    settings = _table(text.get("settings", {}), "settings")
    agents = _table(text.get("agents", {}), "agents")
    return Mapping(
        **names,
        robot=robot,
        settings={name: _settings(value, f'settings."{name}"') for name, value in settings.items()},
        agents={name: _foreign(name, value) for name, value in agents.items()},
    )


def _settings(value: Any, at: str) -> Settings:
    table = _table(value, at)
    _known(table, at, ("content", "client_gone", "fenced_by"))
    for key, choices in _CHOICES.items():
        if key in table and table[key] not in choices:
            raise WrongMapping(f"{at}.{key}: expected {' or '.join(choices)}, got {table[key]!r}")
    if "fenced_by" not in table:
        return Settings(**table)
    fence = _texts(table["fenced_by"], f"{at}.fenced_by")
    if len(fence) != 2:
        raise WrongMapping(f"{at}.fenced_by: expected the owner and the resource of a lock, got {fence!r}")
    return Settings(**{**table, "fenced_by": (fence[0], fence[1])})


def _foreign(agent: str, value: Any) -> Foreign:
    at = f"agents.{agent}"
    table = _table(value, at)
    _known(table, at, KINDS)
    for kind, middle in (("actions", "action"), ("services", "srv"), ("topics", "msg")):
        offered = _table(table.get(kind, {}), f"{at}.{kind}")
        for word, name in offered.items():
            if not all(_WORD.fullmatch(part) for part in (*agent.split("/"), word)):
                raise WrongMapping(f"{at}.{kind}.{word}: ROS has no such name; letters, digits and _ are allowed")
            parts = name.split("/") if isinstance(name, str) else []
            if len(parts) != 3 or parts[1] != middle:
                raise WrongMapping(f"{at}.{kind}.{word}: expected a type PACKAGE/{middle}/NAME, got {name!r}")
    return Foreign(**table)


def _table(value: Any, at: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise WrongMapping(f"{at}: expected a table, got {value!r}")
    return value


def _names(value: Any, at: str) -> list[str]:
    names = _texts(value, at)
    for name in names:
        if not name.startswith("/"):
            raise WrongMapping(f'{at}: names of ROS begin with "/", got {name!r}')
    return names


def _texts(value: Any, at: str) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise WrongMapping(f"{at}: expected texts, got {value!r}")
    return value


def _known(table: dict[str, Any], at: str, keys: tuple[str, ...]) -> None:
    for key in table:
        if key not in keys:
            raise WrongMapping(f"{at + '.' if at else ''}{key} is unknown; expected {', '.join(keys)}")
