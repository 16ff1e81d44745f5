"""The node of the bridge, and the thread in which its callbacks run.

The loop of the agents calls functions there with `Ros.call`. The thread calls the loop with `Ros.ask` and `Inbox`, which
are bounded.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

_log = logging.getLogger("fipa.ros2")

#: The beginning of the names of nodes of bridges. A bridge does not map what another one offers.
NODE = "fipa_bridge"

#: Maximum number of calls that wait: of agents for the services of a robot, and of ROS for agents. Further ones are
#: refused. The library bounds the goals of agents.
MAX_CALLS = 256


class Full(Exception):
    """Too many calls wait already."""


class Ros:
    """The node of the bridge. Its callbacks run in one thread, and `call` runs functions there."""

    def __init__(self, arguments: Sequence[str], loop: asyncio.AbstractEventLoop) -> None:
        # The loop handles the signals.
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node(NODE, enable_rosout=False, start_parameter_services=False)
        self.loop = loop
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._asked = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._is_closed:
            try:
                self._executor.spin_once(timeout_sec=1.0)
            except ExternalShutdownException:
                return
            except Exception:
                # One callback has failed; the others go on.
                _log.exception("a callback of ROS has failed")

    def close(self) -> None:
        self._is_closed = True
        self._executor.wake()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    async def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a function in the thread of ROS. Awaits its result, if that is a future of rclpy."""
        done: asyncio.Future[Any] = self.loop.create_future()
        awaited: list[Future[Any]] = []

        def settle(settled: Callable[[Any], None], value: Any) -> None:
            self.soon(lambda: None if done.done() else settled(value))

        def finish(future: Future[Any]) -> None:
            if (error := future.exception()) is not None:
                settle(done.set_exception, error)
            else:
                settle(done.set_result, future.result())

        def run() -> None:
            try:
                result = function(*arguments)
            except Exception as error:
                settle(done.set_exception, error)
                return
            if isinstance(result, Future):
                awaited.append(result)
                result.add_done_callback(finish)
            else:
                settle(done.set_result, result)

        try:
            self._executor.create_task(run)
            return await done
        except asyncio.CancelledError:
            self._executor.create_task(lambda: [future.cancel() for future in awaited])
            raise

    async def ask(self, work: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Runs a coroutine in the loop of the agents, for a callback in the thread of ROS. Raises `Full`."""
        if self._asked >= MAX_CALLS:
            raise Full(f"{MAX_CALLS} calls wait for agents already")
        answer: Future[Any] = Future(executor=self._executor)

        async def run() -> None:
            try:
                settled, value = answer.set_result, await work()
            except Exception as error:
                settled, value = answer.set_exception, error
            # In the thread of ROS, so that the executor wakes up.
            self._executor.create_task(settled, value)

        self._asked += 1
        # The loop has only a weak reference to the task.
        running = asyncio.run_coroutine_threadsafe(run(), self.loop)
        try:
            return await answer
        finally:
            self._asked -= 1
            running.cancel()

    def soon(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Calls a function in the loop; not if the loop is closed."""
        try:
            self.loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:
            pass


class Inbox:
    """A bounded queue from the thread of ROS to the loop. A full one drops its oldest item, and counts it."""

    def __init__(self, ros: Ros, bound: int) -> None:
        self._ros = ros
        self._items: deque[Any] = deque()
        self._bound = bound
        self._lock = threading.Lock()
        self._ready = asyncio.Event()
        self.dropped = 0

    def put(self, item: Any) -> None:
        """Called in the thread of ROS."""
        with self._lock:
            if len(self._items) == self._bound:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            wakes = len(self._items) == 1
        if wakes:
            self._ros.soon(self._ready.set)

    async def get(self) -> Any:
        while True:
            with self._lock:
                if self._items:
                    return self._items.popleft()
                self._ready.clear()
            await self._ready.wait()
