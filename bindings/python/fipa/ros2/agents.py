"""Agents for ROS: their actions, services and topics become an action server, a service and a publisher."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile

import fipa
from fipa import sl
from fipa.ros2 import values
from fipa.ros2.ros import Doubling, Ros

_log = logging.getLogger("fipa.ros2")

#: Longest time between two attempts to subscribe to a topic of an agent, in seconds.
LONGEST_PAUSE = 5.0

#: Depth of the queue of a publisher.
DEPTH = 10

#: Time for the answer of an agent to a request of ROS, in seconds.
REQUEST = 60.0

#: Maximum number of calls of ROS that wait for the same action or service of an agent. Further ones are refused.
MAX_CALLS = 256


class Full(Exception):
    """Too many calls wait already."""


class Offered:
    """Something of an agent for ROS."""

    def __init__(self, ros: Ros, own: fipa.Agent, agent: str, word: str, kind: Any) -> None:
        """Called in the thread of ROS, as `close` is."""
        self._ros = ros
        self._own = own
        self._agent = agent
        self._word = word
        self._kind = kind
        self._name = f"/{agent}/{word}"
        #: One call that waits must not stop the others.
        self._group = ReentrantCallbackGroup()
        self._waiting = 0
        self._open()

    async def _ask(self, work: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Runs a coroutine in the loop of the agents. Raises `Full`."""
        if self._waiting >= MAX_CALLS:
            raise Full(f"{MAX_CALLS} calls wait already")
        self._waiting += 1
        try:
            return await self._ros.ask(work)
        finally:
            self._waiting -= 1

    def _open(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class AgentAction(Offered):
    """An action of an agent, as an action server of ROS."""

    def _open(self) -> None:
        #: The goals that the agent has accepted, by the identity of the message of ROS.
        self._accepted: dict[int, tuple[Any, fipa.RemoteGoal]] = {}
        self._running: dict[bytes, fipa.RemoteGoal] = {}
        self._server = ActionServer(
            self._ros.node,
            self._kind,
            self._name,
            execute_callback=self._execute,
            goal_callback=self._decide,
            cancel_callback=self._cancel,
            callback_group=self._group,
        )

    def close(self) -> None:
        self._server.destroy()

    async def _decide(self, message: Any) -> GoalResponse:
        async def invoke() -> fipa.RemoteGoal:
            goal = self._own.invoke(self._agent, self._word, values.to_json(message))
            await goal.accepted()
            return goal

        try:
            goal = await self._ask(invoke)
        except (fipa.Error, Full, ValueError) as error:
            # ROS has no reason for a rejected goal.
            _log.warning("%s: a goal is rejected: %s", self._name, error)
            return GoalResponse.REJECT
        self._accepted[id(message)] = (message, goal)
        return GoalResponse.ACCEPT

    async def _execute(self, handle: Any) -> Any:
        _, goal = self._accepted.pop(id(handle.request))
        self._running[bytes(handle.goal_id.uuid)] = goal

        async def follow() -> Any:
            async for progress in goal:
                if isinstance(value := progress.get("value"), dict):
                    await self._ros.call(handle.publish_feedback, values.from_json(self._kind.Feedback, value))
            return values.from_json(self._kind.Result, await goal.result() or {})

        try:
            result = await self._ask(follow)
        except (fipa.Error, Full, ValueError) as error:
            _log.warning("%s: %s", self._name, error)
            if handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            return self._kind.Result()
        finally:
            del self._running[bytes(handle.goal_id.uuid)]
        handle.succeed()
        return result

    def _cancel(self, handle: Any) -> CancelResponse:
        if (goal := self._running.get(bytes(handle.goal_id.uuid))) is None:
            return CancelResponse.REJECT
        goal.cancel()
        return CancelResponse.ACCEPT


class AgentService(Offered):
    """The requests of an agent, as a service of ROS."""

    def _open(self) -> None:
        self._service = self._ros.node.create_service(
            self._kind, self._name, self._answer, callback_group=self._group
        )
        self._send = self._service.send_response
        # ROS has no failure of a service: a request that fails has no answer, so that no client takes it for a success.
        self._service.send_response = self._send_if_any

    def close(self) -> None:
        self._ros.node.destroy_service(self._service)

    def _send_if_any(self, response: Any, header: Any) -> None:
        if response is not None:
            self._send(response, header)

    async def _answer(self, message: Any, _response: Any) -> Any:
        async def request() -> Any:
            content = sl.dumps({"@": self._word, **values.to_json(message)})
            asked = fipa.Message("request", self._agent, content, language="fipa-sl")
            letter = await self._own.request(asked, timeout=REQUEST)
            answer = values.content(letter) if letter.text else {}
            if isinstance(answer, dict):
                answer.pop("@", None)
            return values.from_json(self._kind.Response, answer)

        try:
            return await self._ask(request)
        except (fipa.Error, Full, ValueError, RecursionError) as error:
            reason = str(error)
        _log.warning("%s: no answer: %s", self._name, reason)
        response = self._kind.Response()
        if hasattr(response, "success") and hasattr(response, "message"):
            # As in std_srvs.
            response.message = reason
            return response
        return None


class AgentTopic(Offered):
    """A topic of an agent, as a topic of ROS."""

    def _open(self) -> None:
        events = PublisherEventCallbacks(incompatible_qos=self._warn_once)
        profile = QoSProfile(depth=DEPTH)
        self._publisher = self._ros.node.create_publisher(self._kind, self._name, profile, event_callbacks=events)
        self._has_warned = False
        self._dropped = 0
        self._warnings = Doubling()
        self._task: asyncio.Task[None] | None = None
        self._ros.soon(self._begin)

    def close(self) -> None:
        self._ros.soon(self._end)
        self._ros.node.destroy_publisher(self._publisher)

    def _warn_once(self, _event: object) -> None:
        """Tells the policies of a subscription that do not fit those of the publisher."""
        if not self._has_warned:
            self._has_warned = True
            ends = self._ros.node.get_subscriptions_info_by_topic(self._name)
            policies = "; ".join(f"{end.node_name}: {_policies(end.qos_profile)}" for end in ends)
            _log.warning("%s: reliable, volatile; policies that do not fit: %s", self._name, policies)

    def _begin(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._follow())

    def _end(self) -> None:
        if self._task is not None:
            self._task.cancel()

    async def _follow(self) -> None:
        pause = 1.0
        while True:
            try:
                with self._own.subscribe(self._agent, self._word) as notifications:
                    async for letter in notifications:
                        pause = 1.0
                        self._publish(letter)
            except fipa.Error as error:
                _log.info("%s: %s; next attempt in %.0f s", self._name, error, pause)
            except Exception:
                _log.exception("%s: the subscription has failed; next attempt in %.0f s", self._name, pause)
            await asyncio.sleep(pause)
            pause = min(pause * 2, LONGEST_PAUSE)

    def _publish(self, letter: fipa.Letter) -> None:
        with letter:
            if letter.language == "ros2-cdr":
                if letter.ontology == values.name_of(self._kind):
                    self._publisher.publish(bytes(letter))
                    return
                wrong = f"the type is {letter.ontology!r}"
            else:
                try:
                    self._publisher.publish(values.from_json(self._kind, values.content(letter)))
                    return
                except (ValueError, RecursionError, fipa.Error) as error:
                    wrong = str(error)
        self._dropped += 1
        if self._warnings.is_due(self._dropped):
            _log.warning("%s: %d notifications are dropped, the last because: %s", self._name, self._dropped, wrong)


def _policies(profile: Any) -> str:
    return f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}"


#: What agents offer, by kind, as in the mapping.
KINDS = {"actions": AgentAction, "services": AgentService, "topics": AgentTopic}
