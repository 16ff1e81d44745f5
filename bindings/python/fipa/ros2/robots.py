"""Robots of ROS as agents: their action servers, services and topics."""

from __future__ import annotations

import asyncio
import json
import logging
import uuid
from collections import Counter
from collections.abc import Coroutine
from datetime import datetime, timezone
from typing import Any, Protocol

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from unique_identifier_msgs.msg import UUID

import fipa
from fipa import sl
from fipa.ros2 import describe, graph, values
from fipa.ros2.mapping import Settings
from fipa.ros2.ros import Doubling, Inbox, Ros

_log = logging.getLogger("fipa.ros2")

#: The space of the ids of goals.
_SPACE = uuid.UUID("8d5a2c7e-0c53-5c0f-9a55-6b1b5a3f7d10")

#: Maximum number of messages of a topic that wait for the agent, and that the agent keeps for new subscribers.
WAITING = 64

#: Maximum size of a message of a topic in JSON, in bytes of ROS.
MAX_JSON = 1_000_000

#: Maximum number of goals and of requests of one client that wait for an action or a service.
SHARE = 32

#: Maximum number of calls that a server has not answered. Further ones wait: its queue in ROS loses what is too much.
AT_ONCE = 8

#: Maximum time for the answer of a service, in seconds.
LONGEST = 60.0

#: Time for the answer of an action server to a goal, in seconds. The client waits ten seconds.
ANSWER = 5.0

#: Time in which an action server says that it does not know a goal, in seconds.
UNKNOWN = 2.0


def goal_id(client: str | None, goal: str) -> uuid.UUID:
    """The id in ROS of a goal. A goal that its client sends again has the same one, so the server runs it once."""
    return uuid.uuid5(_SPACE, f"{client}\n{goal}")


class Mapped(Protocol):
    """Something of ROS that an agent offers."""

    async def run(self) -> None:
        """Serves until `close`."""

    async def close(self) -> None:
        """Ends. What waits for the server ends as gone."""


class Tasks:
    """Running work, which the loop alone would forget."""

    def __init__(self) -> None:
        self._running: set[asyncio.Task[None]] = set()

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._running.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        error = None if task.cancelled() else task.exception()
        # The end of an agent closes its sequences.
        if error is not None and not isinstance(error, fipa.Closed):
            _log.error("a conversation has failed", exc_info=error)

    async def end(self) -> None:
        if self._running:
            await asyncio.wait(self._running)


class Action:
    """An action server of ROS, as an action of an agent."""

    def __init__(self, ros: Ros, agent: fipa.Agent, name: str, word: str, kind: Any, settings: Settings) -> None:
        self._ros = ros
        self._kind = kind
        self._gone = asyncio.Event()
        self._tasks = Tasks()
        self._slots = asyncio.Semaphore(AT_ONCE)
        self._shares: Counter[str | None] = Counter()
        self.name = name
        self.goals = agent.goals(describe.action(word, kind, settings))
        self._client = ActionClient(ros.node, kind, name)

    async def run(self) -> None:
        async for goal in self.goals:
            self._tasks.start(self._pursue(goal))

    async def close(self) -> None:
        self._gone.set()
        await self._tasks.end()
        self.goals.close()
        await self._ros.call(self._client.destroy)

    async def _pursue(self, goal: fipa.Goal) -> None:
        self._shares[goal.client] += 1
        try:
            try:
                reason = await self._lead(goal)
            except (ValueError, _Gone) as error:
                reason = str(error)
            if reason is not None:
                goal.fail(reason)
        except fipa.Error as error:
            # The time for a stop is over: the client has an outcome.
            _log.info("a goal of %s has ended before: %s", self.name, error)
        finally:
            self._shares -= Counter([goal.client])

    async def _lead(self, goal: fipa.Goal) -> str | None:
        """Leads a goal to its result. Returns the reason of a failure."""
        if self._shares[goal.client] > SHARE:
            return f"{SHARE} goals of the client run already"
        message = values.from_json(self._kind.Goal, goal.arguments)
        if self._ros.node.count_services(f"{self.name}/_action/send_goal") > 1:
            return f"{self.name} has more than one action server"
        identity = UUID(uuid=list(goal_id(goal.client, goal.id).bytes))
        feedback = Inbox(self._ros, 1)
        gone = asyncio.ensure_future(self._gone.wait())
        stopped = asyncio.ensure_future(_wait(goal.stopped()))
        waits = [gone, stopped, asyncio.ensure_future(_report(goal, feedback))]
        try:
            sending = _Sending(self._client, message, identity, feedback)
            try:
                async with self._slots:
                    handle = await _unless(gone, asyncio.ensure_future(self._ros.call(sending.begin)), ANSWER)
            except TimeoutError:
                return "the action server does not answer; it may have died"
            waits.append(result := asyncio.ensure_future(self._ros.call(handle.get_result_async)))
            if not handle.accepted:
                # A server rejects a goal that it has: one that a bridge sent which has died. It answers at once if it
                # does not have the goal.
                await asyncio.wait({result, gone}, timeout=UNKNOWN, return_when=asyncio.FIRST_COMPLETED)
                if result.done() and result.result().status == GoalStatus.STATUS_UNKNOWN:
                    return "the action server rejects the goal"
            goal.accept()
            await asyncio.wait({result, gone, stopped}, return_when=asyncio.FIRST_COMPLETED)
            if stopped.done() and not result.done():
                await _unless(gone, asyncio.ensure_future(self._ros.call(handle.cancel_goal_async)))
            return _end(goal, await _unless(gone, result))
        finally:
            for task in waits:
                task.cancel()


class _Sending:
    """A goal that is sent. If the bridge has given up when the server accepts it, it is canceled."""

    def __init__(self, client: ActionClient, message: Any, identity: UUID, feedback: Inbox) -> None:
        self._client = client
        self._goal = (message, lambda it: feedback.put(it.feedback), identity)
        self._answer: Future[Any] = Future()

    def begin(self) -> Future[Any]:
        """Called in the thread of ROS, as the callbacks are."""
        self._client.send_goal_async(*self._goal).add_done_callback(self._answered)
        return self._answer

    def _answered(self, sent: Future[Any]) -> None:
        if not self._answer.cancelled():
            self._answer.set_result(sent.result())
        elif (handle := sent.result()) is not None and handle.accepted:
            handle.cancel_goal_async()


class _Gone(Exception):
    """The server has died."""

    def __str__(self) -> str:
        return "gone: the server in ROS has died or ended"


async def _wait(pending: Any) -> Any:
    return await pending


async def _report(goal: fipa.Goal, feedback: Inbox) -> None:
    while True:
        message = await feedback.get()
        try:
            goal.progress(value=values.to_json(message))
        except values.TooLarge:
            # The result may be smaller.
            pass


async def _unless(gone: asyncio.Future[Any], work: asyncio.Future[Any], within: float | None = None) -> Any:
    """Waits for the work, unless the server dies. Raises `_Gone` and `TimeoutError`."""
    await asyncio.wait({work, gone}, timeout=within, return_when=asyncio.FIRST_COMPLETED)
    if work.done():
        return work.result()
    work.cancel()
    if gone.done():
        raise _Gone
    raise TimeoutError


def _end(goal: fipa.Goal, response: Any) -> str | None:
    result = values.to_json(response.result)
    if response.status == GoalStatus.STATUS_SUCCEEDED:
        goal.succeed(result)
        return None
    if response.status == GoalStatus.STATUS_CANCELED:
        return goal.stop_reason or "the action server has canceled the goal"
    if response.status == GoalStatus.STATUS_UNKNOWN:
        return "the action server does not know the goal any more"
    return f"the action server has aborted the goal: {json.dumps(result)[:500]}"


class Service:
    """A service of ROS: requests whose content is its name with the arguments, `(set_bool :data true)`."""

    def __init__(self, ros: Ros, name: str, kind: Any) -> None:
        self._ros = ros
        self._kind = kind
        self._client = ros.node.create_client(kind, name)
        self._gone = asyncio.Event()
        self._slots = asyncio.Semaphore(AT_ONCE)
        self._shares: Counter[str | None] = Counter()

    async def run(self) -> None:
        await self._gone.wait()

    async def close(self) -> None:
        self._gone.set()
        await self._ros.call(self._ros.node.destroy_client, self._client)

    async def answer(self, task: fipa.Task, arguments: dict[str, Any]) -> None:
        """Answers a request."""
        client = task.letter.sender
        if self._shares[client] >= SHARE:
            await task.refuse(f"{SHARE} requests of {client} wait already")
            return
        try:
            message = values.from_json(self._kind.Request, arguments)
        except values.Mismatch as error:
            await task.refuse(str(error))
            return
        gone = asyncio.ensure_future(self._gone.wait())
        work = asyncio.ensure_future(self._call(message))
        cancelled = asyncio.ensure_future(_wait(task.cancelled()))
        cancelled.add_done_callback(lambda _: work.cancel())
        self._shares[client] += 1
        try:
            await task.agree()
            answer = await _unless(gone, work, _left(task.letter))
            await task.inform(written(task.letter, values.to_json(answer)))
        except asyncio.CancelledError:
            # ROS has no cancel of a service: its answer is ignored.
            await task.inform("cancelled")
        except TimeoutError:
            await task.fail("the service has not answered in time")
        except fipa.Error:
            raise
        except Exception as error:
            # Also a text that ROS does not send.
            await task.fail(str(error))
        finally:
            self._shares -= Counter([client])
            gone.cancel()
            # And the work.
            cancelled.cancel()

    async def _call(self, message: Any) -> Any:
        async with self._slots:
            # This function of rclpy may be called in each thread.
            return await self._ros.finished(self._client.call_async(message))


def _left(letter: fipa.Letter) -> float:
    """The time for the answer to a request, in seconds."""
    if letter.reply_by is None:
        return LONGEST
    return max(0.0, min((letter.reply_by - datetime.now(timezone.utc)).total_seconds(), LONGEST))


class Requests:
    """The requests of an agent, for its services."""

    def __init__(self, agent: fipa.Agent) -> None:
        self.services: dict[str, Service] = {}
        self._tasks = Tasks()
        self._requests = agent.tasks("fipa-request")

    async def run(self) -> None:
        async for task in self._requests:
            self._tasks.start(self._answer(task))

    def close(self) -> None:
        self._requests.close()

    async def _answer(self, task: fipa.Task) -> None:
        try:
            try:
                word, arguments = read(task.letter)
            except (ValueError, RecursionError, fipa.Error) as error:
                await task.refuse(f"expected a service with its arguments, such as (set_bool :data true): {error}")
                return
            service = self.services.get(word)
            if service is None:
                known = ", ".join(sorted(self.services)) or "none"
                await task.refuse(f"{word!r} is no service of this agent; its services: {known}")
            else:
                await service.answer(task, arguments)
        except fipa.Error as error:
            # The client is gone.
            _log.info("a request has ended: %s", error)


async def answer_others(agent: fipa.Agent) -> None:
    """Answers what begins a conversation that the agent does not lead, until the agent is deregistered."""
    try:
        while True:
            letter = await agent.receive()
            if letter.performative in ("request", "subscribe", "query-ref", "query-if", "cfp", "propose"):
                text = f"{agent.name} has no such action, service or topic now"
                await agent.answer(letter, fipa.Message("not-understood", letter.sender or "", text))
    except fipa.Error as error:
        _log.debug("the agent %s has ended: %s", agent.name, error)


def read(letter: fipa.Letter) -> tuple[str, dict[str, Any]]:
    """Reads the content of a request: `(set_bool :data true)` in SL, `{"@": "set_bool", "data": true}` in JSON."""
    value = values.content(letter)
    if isinstance(value, str):
        return value, {}
    if not isinstance(value, dict) or not isinstance(word := value.pop("@", None), str):
        raise ValueError("the content has no name")
    return word, value


def written(letter: fipa.Letter, value: dict[str, Any]) -> str:
    """Writes an answer in the language of the question."""
    return json.dumps(value) if letter.language == "json" else sl.dumps(value)


class Topic:
    """A topic of ROS, as a topic of an agent."""

    def __init__(self, ros: Ros, agent: fipa.Agent, name: str, word: str, kind: Any, content: str) -> None:
        self._ros = ros
        self._kind = kind
        self.name = name
        self._is_raw = content == "cdr"
        profile = graph.profile(ros.node, name, WAITING)
        self._is_kept = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._inbox = Inbox(ros, WAITING)
        self._publisher = agent.publisher(
            word,
            language="ros2-cdr" if self._is_raw else "json",
            ontology=values.name_of(kind),
            latched=profile.depth if self._is_kept else 0,
        )
        # Its bytes: only a message that some agent wants is decoded.
        self._subscription = ros.node.create_subscription(kind, name, self._inbox.put, profile, raw=True)
        self._task: asyncio.Task[None] | None = None
        #: Number of messages that could not be published, and why the last one could not.
        self._unpublished, self._reason = 0, "none"
        self._warnings = Doubling()

    async def run(self) -> None:
        self._task = asyncio.current_task()
        while True:
            message: bytes = await self._inbox.get()
            if self._is_kept or self._publisher.subscribers:
                try:
                    await self._publish(message)
                except fipa.Closed:
                    return
                except Exception as error:
                    # A message that is too large, or that Python cannot read, does not end the topic.
                    self._unpublished, self._reason = self._unpublished + 1, str(error)[:200]
            lost = self._inbox.dropped + self._unpublished
            if self._warnings.is_due(lost):
                text = "%s: %d messages were dropped, because subscribers are slow, %d for other reasons; the last: %s"
                _log.warning(text, self.name, self._inbox.dropped, self._unpublished, ascii(self._reason))

    async def _publish(self, message: bytes) -> None:
        if self._is_raw:
            loan = self._publisher.loan(len(message))
            with memoryview(loan) as place:
                place[:] = message
            await loan.publish()
        elif len(message) > MAX_JSON:
            raise values.TooLarge(f'it has {len(message)} bytes; set `content = "cdr"` for more than {MAX_JSON}')
        else:
            value = values.to_json(deserialize_message(message, self._kind))
            await self._publisher.publish(json.dumps(value).encode())

    async def close(self) -> None:
        await self._ros.call(self._ros.node.destroy_subscription, self._subscription)
        if self._task is not None:
            self._task.cancel()
        self._publisher.close()
