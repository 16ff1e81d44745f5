"""The bridge: keeps what the mapping names open, as the graph of ROS changes."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState

import fipa
from fipa.ros2 import agents, graph, robots
from fipa.ros2.graph import Entity
from fipa.ros2.mapping import KINDS, Mapping
from fipa.ros2.ros import Ros
from fipa.ros2.values import UnknownType, load

_log = logging.getLogger("fipa.ros2")

#: Time between two looks at the graph in seconds. ROS reports no end of a server.
LOOK = 0.5

#: Time until the directory is asked again, if it did not answer, in seconds.
DIRECTORY_PAUSE = 10.0


class _Robot:
    """An agent of a namespace of ROS."""

    def __init__(self, agent: fipa.Agent) -> None:
        self.agent = agent
        self.requests: robots.Requests | None = None
        #: What is open, by kind and name of ROS.
        self.open: dict[tuple[str, str], tuple[Entity, robots.Mapped]] = {}
        self.listed: set[tuple[str, str]] = set()


class _Lifecycles:
    """The states of the lifecycle nodes, whose mappings exist while they are active."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros
        self._clients: dict[str, Any] = {}
        self._active: set[str] = set()

    async def inactive(self, nodes: set[str]) -> set[str]:
        """Returns those of the nodes that are not active. One that does not answer in time is as it was."""
        for node in set(self._clients) - nodes:
            await self._ros.call(self._ros.node.destroy_client, self._clients.pop(node))
        self._active &= nodes
        await asyncio.gather(*(self._look(node) for node in nodes))
        return nodes - self._active

    async def _look(self, node: str) -> None:
        if node not in self._clients:
            create = self._ros.node.create_client
            self._clients[node] = await self._ros.call(create, GetState, f"{node}/get_state")
        try:
            asked = self._ros.call(self._clients[node].call_async, GetState.Request())
            answer = await asyncio.wait_for(asked, LOOK)
        except asyncio.TimeoutError:
            return
        if answer.current_state.id == State.PRIMARY_STATE_ACTIVE:
            self._active.add(node)
        else:
            self._active.discard(node)


class Bridge:
    """A bridge between a domain of agents and ROS."""

    def __init__(self, ros: Ros, domain: fipa.Domain, mapping: Mapping, name: str) -> None:
        self._ros = ros
        self._domain = domain
        self._mapping = mapping
        self._name = name
        self._robots: dict[str, _Robot] = {}
        self._foreign: list[Any] = []
        self._tasks = robots.Tasks()
        #: The mistakes that were told, by kind and name of ROS.
        self._warned: dict[tuple[str, str], object] = {}
        self._list_at = 0.0
        self._lifecycles = _Lifecycles(ros)

    async def run(self) -> None:
        """Runs until it is cancelled, and ends what it has opened."""
        loop = asyncio.get_running_loop()
        try:
            await self._offer_agents()
            while True:
                began = loop.time()
                found = await self._ros.call(graph.mapped_entities, self._ros.node, self._mapping)
                inactive = await self._lifecycles.inactive({node for it in found for node in it.lifecycle})
                await self._follow([it for it in found if inactive.isdisjoint(it.lifecycle)])
                await self._list()
                # A look at a large graph takes long.
                await asyncio.sleep(max(LOOK, 3 * (loop.time() - began)))
        finally:
            await self._close()

    async def _offer_agents(self) -> None:
        """Offers the agents of the mapping to ROS. Raises `UnknownType`."""
        if not self._mapping.agents:
            return
        own = await self._domain.register(self._name, type="bridge", description="fipa-ros2")
        for agent, offered in self._mapping.agents.items():
            for kind in KINDS:
                for word, type_name in getattr(offered, kind).items():
                    made = await self._ros.call(
                        agents.KINDS[kind], self._ros, own, agent, word, load(type_name)
                    )
                    self._foreign.append(made)
                    _log.info("/%s/%s is %s of the agent %s", agent, word, _one(kind), agent)

    async def _follow(self, found: list[Entity]) -> None:
        """Opens what has appeared, and closes what has gone."""
        present = {(it.kind, it.name): it for it in found}
        closing = []
        for name, robot in list(self._robots.items()):
            # Its last letters have left since the look before.
            if not robot.open:
                del self._robots[name]
                self._end(robot)
            for key, (known, mapped) in list(robot.open.items()):
                entity = present.get(key)
                if entity is not None and entity.follows(known):
                    robot.open[key] = (entity, mapped)
                    continue
                _log.info("%s has %s", key[1], "gone" if entity is None else "changed")
                del robot.open[key]
                if robot.requests is not None and key[0] == "services":
                    robot.requests.services.pop(key[1].rsplit("/", 1)[1], None)
                closing.append(mapped.close())
        await asyncio.gather(*closing)
        is_open = {key for robot in self._robots.values() for key in robot.open}
        for entity in found:
            if (entity.kind, entity.name) not in is_open:
                await self._open(entity)

    def _obstacle(self, entity: Entity, place: tuple[str, str] | None) -> str | None:
        """Returns why this cannot be mapped to a place, an agent and the name there."""
        if len(entity.types) > 1:
            return f"has several types: {', '.join(entity.types)}"
        if entity.is_looped:
            return "is published by a bridge, too: its messages would go round"
        if len(entity.servers) > 1:
            return f"has {len(entity.servers)} servers; one is expected"
        if place is None:
            return 'has no namespace: set `robot = "NAME"` in the mapping'
        agent, word = place
        if agent in ("df", "ams"):
            return f"has a namespace that is the name of an agent of the platform: {agent}"
        robot = self._robots.get(agent)
        requests = robot.requests if robot is not None else None
        if entity.kind == "services" and requests is not None and word in requests.services:
            return f"is not mapped: {agent} has a service {word} already"
        return None

    async def _open(self, entity: Entity) -> None:
        place = self._mapping.agent_of(entity.name)
        obstacle = self._obstacle(entity, place)
        if place is None or obstacle is not None:
            self._warn(entity, obstacle or "")
            return
        try:
            kind = load(entity.types[0])
            robot = await self._robot(place[0])
            mapped = await self._made(entity, robot, place[1], kind)
        except (UnknownType, fipa.Error) as error:
            self._warn(entity, f"is not mapped: {error}", type(error))
            return
        self._warned.pop((entity.kind, entity.name), None)
        robot.open[entity.kind, entity.name] = (entity, mapped)
        robot.listed.clear()
        self._list_at = 0.0
        self._tasks.start(mapped.run())
        _log.info("%s is %s %s of the agent %s", entity.name, _one(entity.kind), place[1], place[0])

    async def _made(self, entity: Entity, robot: _Robot, word: str, kind: Any) -> robots.Mapped:
        settings = self._mapping.of(entity.name)
        if entity.kind == "actions":
            return robots.Action(self._ros, robot.agent, entity.name, word, kind, settings)
        if entity.kind == "topics":
            return robots.Topic(self._ros, robot.agent, entity.name, word, kind, settings.content)
        if robot.requests is None:
            robot.requests = robots.Requests(robot.agent)
            self._tasks.start(robot.requests.run())
        service = robots.Service(self._ros, entity.name, kind)
        robot.requests.services[word] = service
        return service

    async def _robot(self, name: str) -> _Robot:
        robot = self._robots.get(name)
        if robot is None:
            agent = await self._domain.register(name, type="robot", description="a robot of ROS 2")
            robot = self._robots[name] = _Robot(agent)
            self._tasks.start(robots.answer_others(agent))
        return robot

    def _end(self, robot: _Robot) -> None:
        if robot.requests is not None:
            robot.requests.close()
        robot.agent.deregister()

    def _warn(self, entity: Entity, text: str, mistake: object = None) -> None:
        """Warns once of a mistake, `mistake` or the text."""
        key, mistake = (entity.kind, entity.name), mistake or text
        if self._warned.get(key) != mistake:
            self._warned[key] = mistake
            _log.warning("%s %s", entity.name, text)

    async def _list(self) -> None:
        """Lists actions and services in the directory; topics are there by themselves."""
        loop = asyncio.get_running_loop()
        if loop.time() < self._list_at:
            return
        self._list_at = loop.time() + DIRECTORY_PAUSE
        for robot in self._robots.values():
            for key, (entity, _) in robot.open.items():
                kind, name = key
                if kind == "topics" or key in robot.listed:
                    continue
                try:
                    word, properties = name.rsplit("/", 1)[1], {"ros-type": entity.types[0]}
                    await robot.agent.register_service(_one(kind), word, properties=properties)
                except fipa.Error as error:
                    _log.debug("the directory does not list %s: %s", name, error)
                    return
                robot.listed.add(key)

    async def _close(self) -> None:
        await asyncio.gather(*(mapped.close() for robot in self._robots.values() for _, mapped in robot.open.values()))
        for robot in self._robots.values():
            self._end(robot)
        for made in self._foreign:
            await self._ros.call(made.close)


def _one(kind: str) -> str:
    return kind[:-1]
