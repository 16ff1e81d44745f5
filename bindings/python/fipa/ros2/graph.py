"""What the graph of ROS has: actions, services and topics, and which of them a bridge may map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from rclpy.action import get_action_names_and_types
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from fipa.ros2.mapping import Mapping
from fipa.ros2.ros import NODE

#: Services of the packages that control nodes: parameters, lifecycle, components. `--list` comments them out.
CONTROLS = ("rcl_interfaces", "lifecycle_msgs", "type_description_interfaces", "composition_interfaces")

_STATUS = "/_action/status"
#: The name of a node that was discovered in part.
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


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
    #: The policies of its publishers.
    policies: tuple[object, ...] = ()
    #: Whether a bridge publishes it, too: its messages would go round.
    is_looped: bool = False

    def follows(self, known: Entity) -> bool:
        """Whether this is the same as at an earlier look, perhaps with further servers."""
        is_alike = (self.types, self.policies, self.is_looped) == (known.types, known.policies, known.is_looped)
        return is_alike and self.servers >= known.servers


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
    nodes, managed = _nodes_of_services(node)
    entities = []
    for entity in named:
        if entity.kind == "services":
            publishers, by = [], nodes.get(entity.name, [])
        else:
            topic = entity.name + _STATUS if entity.kind == "actions" else entity.name
            publishers = node.get_publishers_info_by_topic(topic)
            by = [_full(it.node_namespace, it.node_name) for it in publishers]
        # A node that was discovered in part has its name at the next look.
        others = [name for name in by if not _is_bridge(name) and not name.endswith(_UNKNOWN)]
        if not others:
            continue
        lifecycle = tuple(name for name in others if name in managed)
        found = replace(entity, lifecycle=lifecycle)
        if entity.kind == "topics":
            policies = _policies(publishers)
            found = replace(found, policies=policies, is_looped=any(map(_is_bridge, by)))
        elif entity.kind == "actions":
            found = replace(found, servers=frozenset(bytes(it.endpoint_gid) for it in publishers))
        else:
            # ROS numbers no servers of services.
            found = replace(found, servers=frozenset(range(node.count_services(entity.name))))
        entities.append(found)
    return entities


def _nodes_of_services(node: Node) -> tuple[dict[str, list[str]], set[str]]:
    """The nodes of each service, and the lifecycle nodes."""
    nodes: dict[str, list[str]] = {}
    managed = set()
    for name, namespace in set(node.get_node_names_and_namespaces()):
        full = _full(namespace, name)
        for service, types in _services_of(node, name, namespace):
            nodes.setdefault(service, []).append(full)
            if service == f"{full}/get_state" and "lifecycle_msgs/srv/GetState" in types:
                managed.add(full)
    return nodes, managed


def _services_of(node: Node, name: str, namespace: str) -> list[tuple[str, list[str]]]:
    try:
        return list(node.get_service_names_and_types_by_node(name, namespace))
    except Exception:  # rclpy raises NodeNameNonExistentError, or RuntimeError in other releases
        # The node has ended since it was listed.
        return []


def _full(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _is_bridge(name: str) -> bool:
    return name.rsplit("/", 1)[1].startswith(NODE)


def _policies(publishers: Iterable[Any]) -> tuple[Any, Any]:
    """Reliability and durability of a subscription that fits every publisher."""
    profiles = [it.qos_profile for it in publishers]
    is_reliable = all(it.reliability == ReliabilityPolicy.RELIABLE for it in profiles)
    is_kept = bool(profiles) and all(it.durability == DurabilityPolicy.TRANSIENT_LOCAL for it in profiles)
    return (
        ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        DurabilityPolicy.TRANSIENT_LOCAL if is_kept else DurabilityPolicy.VOLATILE,
    )


def profile(node: Node, topic: str, longest: int) -> QoSProfile:
    """The policies of a subscription that fits every publisher of a topic."""
    publishers = node.get_publishers_info_by_topic(topic)
    reliability, durability = _policies(publishers)
    # ROS does not tell every depth.
    least = 1 if durability == DurabilityPolicy.TRANSIENT_LOCAL else 10
    depth = max((it.qos_profile.depth for it in publishers), default=0)
    return QoSProfile(depth=min(max(depth, least), longest), reliability=reliability, durability=durability)


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
