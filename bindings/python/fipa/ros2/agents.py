"""Agents for ROS: their actions, services and topics become an action server, a service and a publisher."""

from __future__ import annotations

import asyncio
import json
import logging
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.qos import QoSProfile

import fipa
from fipa import sl
from fipa.ros2 import values
from fipa.ros2.ros import Full, Ros

_log = logging.getLogger("fipa.ros2")

#: Longest time between two attempts to subscribe to a topic of an agent, in seconds.
LONGEST_PAUSE = 5.0

#: Depth of the queue of a publisher.
DEPTH = 10


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
        self._open()

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
        )

    def close(self) -> None:
        self._server.destroy()

    async def _decide(self, message: Any) -> GoalResponse:
        async def invoke() -> fipa.RemoteGoal:
            goal = self._own.invoke(self._agent, self._word, values.to_json(message))
            await goal.accepted()
            return goal

        try:
            goal = await self._ros.ask(invoke)
        except (fipa.Error, Full) as error:
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
            result = await self._ros.ask(follow)
        except (fipa.Error, values.Mismatch, Full) as error:
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
        self._service = self._ros.node.create_service(self._kind, self._name, self._answer)
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
            letter = await self._own.request(fipa.Message("request", self._agent, content, language="fipa-sl"))
            text = letter.text
            answer = json.loads(text) if letter.language == "json" else sl.loads(text) if text else {}
            if isinstance(answer, dict):
                answer.pop("@", None)
            return values.from_json(self._kind.Response, answer)

        try:
            return await self._ros.ask(request)
        except (fipa.Error, values.Mismatch, Full) as error:
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
        self._publisher = self._ros.node.create_publisher(self._kind, self._name, QoSProfile(depth=DEPTH))
        self._task: asyncio.Task[None] | None = None
        self._ros.soon(self._begin)

    def close(self) -> None:
        self._ros.soon(self._end)
        self._ros.node.destroy_publisher(self._publisher)

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
            await asyncio.sleep(pause)
            pause = min(pause * 2, LONGEST_PAUSE)

    def _publish(self, letter: fipa.Letter) -> None:
        with letter:
            if letter.language == "ros2-cdr":
                if letter.ontology == values.name_of(self._kind):
                    self._publisher.publish(bytes(letter))
                    return
                wrong = f"the type is {letter.ontology}"
            else:
                try:
                    value = json.loads(letter.text) if letter.language == "json" else sl.loads(letter.text)
                    self._publisher.publish(values.from_json(self._kind, value))
                    return
                except ValueError as error:
                    wrong = str(error)
        _log.warning("%s: a notification is dropped: %s", self._name, wrong)


#: What agents offer, by kind, as in the mapping.
KINDS = {"actions": AgentAction, "services": AgentService, "topics": AgentTopic}
