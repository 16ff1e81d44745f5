"""What the graph of ROS has: actions, services and topics, and which of them a bridge may map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.action import get_action_names_and_types
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fipa.ros2.mapping import Mapping
from fipa.ros2.ros import NODE

#: Services of the packages that control nodes: parameters, lifecycle, components. `--list` comments them out.
CONTROLS = ("rcl_interfaces", "lifecycle_msgs", "type_description_interfaces", "composition_interfaces")

_STATUS = "/_action/status"


@dataclass(frozen=True)
class Entity:
    """An action, a service or a topic."""

    #: `actions`, `services` or `topics`, as in the mapping.
    kind: str
    name: str
    #: The types that nodes give it; more than one is a mistake of theirs.
    types: tuple[str, ...]
    #: Its servers: an id of each, as far as ROS tells one. One that was started again has another id.
    servers: frozenset[object] = frozenset()
    #: The lifecycle nodes that offer it.
    lifecycle: tuple[str, ...] = ()


def all_entities(node: Node) -> list[Entity]:
    """Everything that is not hidden, without a look at its servers."""
    found = [("actions", it) for it in get_action_names_and_types(node)]
    found += [("services", it) for it in node.get_service_names_and_types()]
    found += [("topics", it) for it in node.get_topic_names_and_types()]
    return [Entity(kind, name, tuple(types)) for kind, (name, types) in found if "/_" not in name]


def mapped_entities(node: Node, mapping: Mapping) -> list[Entity]:
    """What the mapping names and some node that is no bridge offers."""
    named = [it for it in all_entities(node) if mapping.maps(it.kind, it.name)]
    if not named:
        return []
    nodes = _nodes_of_services(node)
    entities = []
    for entity in named:
        servers: Iterable[object] = ()
        if entity.kind == "services":
            by = nodes.get(entity.name, [])
            # ROS numbers no servers of services.
            servers = range(node.count_services(entity.name))
        else:
            topic = entity.name + _STATUS if entity.kind == "actions" else entity.name
            publishers = node.get_publishers_info_by_topic(topic)
            by = [_full(it.node_namespace, it.node_name) for it in publishers]
            if entity.kind == "actions":
                servers = (bytes(it.endpoint_gid) for it in publishers)
        others = [name for name in by if not _is_bridge(name)]
        if others:
            lifecycle = tuple(name for name in others if f"{name}/get_state" in nodes)
            entities.append(Entity(entity.kind, entity.name, entity.types, frozenset(servers), lifecycle))
    return entities


def _nodes_of_services(node: Node) -> dict[str, list[str]]:
    servers: dict[str, list[str]] = {}
    for name, namespace in set(node.get_node_names_and_namespaces()):
        for service in _services_of(node, name, namespace):
            servers.setdefault(service, []).append(_full(namespace, name))
    return servers


def _services_of(node: Node, name: str, namespace: str) -> Iterable[str]:
    try:
        return [service for service, _ in node.get_service_names_and_types_by_node(name, namespace)]
    except Exception:  # rclpy raises NodeNameNonExistentError, or RuntimeError in other releases
        # The node has ended since it was listed.
        return []


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _is_bridge(name: str) -> bool:
    return name.rsplit("/", 1)[1].startswith(NODE)


def profile(node: Node, topic: str, longest: int) -> QoSProfile:
    """The policies of a subscription that fits every publisher of a topic."""
    profiles = [it.qos_profile for it in node.get_publishers_info_by_topic(topic)]
    is_reliable = all(it.reliability == ReliabilityPolicy.RELIABLE for it in profiles)
    is_kept = all(it.durability == DurabilityPolicy.TRANSIENT_LOCAL for it in profiles)
    depth = max((it.depth for it in profiles), default=0)
    return QoSProfile(
        # ROS does not tell every depth.
        depth=min(max(depth, 1 if is_kept else 10), longest),
        reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if is_kept else DurabilityPolicy.VOLATILE,
    )


def listing(entities: Iterable[Entity]) -> str:
    """A mapping of everything. What controls nodes is commented out."""
    lines = [
        "# A mapping of fipa-ros2: what agents reach. Remove what they must not reach.",
        '# Patterns such as "/crex/*" name several. Settings, and agents for ROS: see `fipa-ros2 --help`.',
    ]
    by_name = sorted(entities, key=lambda it: it.name)
    for kind in ("actions", "services", "topics"):
        lines += ["", f"{kind} = ["]
        for entity in (it for it in by_name if it.kind == kind):
            types = ", ".join(entity.types)
            controls = any(name.split("/")[0] in CONTROLS for name in entity.types) or entity.name == "/rosout"
            lines.append(f'    {"# " if controls else ""}"{entity.name}",  # {types}')
        lines.append("]")
    return "\n".join(lines) + "\n"
