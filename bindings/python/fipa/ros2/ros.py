"""The node of the bridge, and the thread in which its callbacks run.

The loop of the agents calls functions there with `Ros.call`. The thread reaches the loop by `Ros.ask` and `Inbox`.
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

#: Maximum number of bytes that wait in an `Inbox`, beside its newest item.
MAX_WAITING = 64_000_000


class Ros:
    """The node of the bridge. Its callbacks run in one thread, and `call` runs functions there."""

    def __init__(self, arguments: Sequence[str], loop: asyncio.AbstractEventLoop) -> None:
        # The loop handles the signals.
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node(NODE, enable_rosout=False, start_parameter_services=False)
        self.loop = loop
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
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

        def run() -> None:
            if done.cancelled():
                return
            try:
                result = function(*arguments)
            except Exception as error:
                self.soon(settle, done.set_exception, error)
            else:
                self.soon(settle, done.set_result, result)

        def settle(settled: Callable[[Any], None], value: Any) -> None:
            if not done.done():
                settled(value)
            elif isinstance(value, Future):
                self._executor.create_task(value.cancel)

        self._executor.create_task(run)
        result = await done
        return await self.finished(result) if isinstance(result, Future) else result

    async def finished(self, future: Future[Any]) -> Any:
        """Awaits a future of rclpy. Cancels it with the wait."""
        done: asyncio.Future[Any] = self.loop.create_future()

        def finish(future: Future[Any]) -> None:
            error = future.exception()
            settled, value = (done.set_result, future.result()) if error is None else (done.set_exception, error)
            self.soon(lambda: None if done.done() else settled(value))

        future.add_done_callback(finish)
        try:
            return await done
        except asyncio.CancelledError:
            self._executor.create_task(future.cancel)
            raise

    async def ask(self, work: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Runs a coroutine in the loop of the agents, for a callback in the thread of ROS."""
        answer: Future[Any] = Future(executor=self._executor)

        async def run() -> None:
            try:
                settled, value = answer.set_result, await work()
            except Exception as error:
                settled, value = answer.set_exception, error
            # In the thread of ROS, so that the executor wakes up.
            self._executor.create_task(settled, value)

        # The loop has only a weak reference to the task.
        running = asyncio.run_coroutine_threadsafe(run(), self.loop)
        try:
            return await answer
        finally:
            running.cancel()

    def soon(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Calls a function in the loop; not if the loop is closed."""
        try:
            self.loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:
            pass


class Doubling:
    """Says when to warn of a count again: when it has doubled since the last warning."""

    def __init__(self) -> None:
        self._next = 1

    def is_due(self, count: int) -> bool:
        if count < self._next:
            return False
        self._next = count * 2
        return True


class Inbox:
    """A bounded queue from the thread of ROS to the loop. A full one drops its oldest item, and counts it."""

    def __init__(self, ros: Ros, bound: int) -> None:
        self._ros = ros
        self._items: deque[Any] = deque()
        self._bound = bound
        self._size = 0
        self._lock = threading.Lock()
        self._ready = asyncio.Event()
        self.dropped = 0

    def put(self, item: Any) -> None:
        """Called in the thread of ROS."""
        size = len(item) if isinstance(item, bytes) else 0
        with self._lock:
            while self._items and (len(self._items) == self._bound or self._size + size > MAX_WAITING):
                self._take()
                self.dropped += 1
            self._items.append((item, size))
            self._size += size
            wakes = len(self._items) == 1
        if wakes:
            self._ros.soon(self._ready.set)

    def _take(self) -> Any:
        item, size = self._items.popleft()
        self._size -= size
        return item

    async def get(self) -> Any:
        while True:
            with self._lock:
                if self._items:
                    return self._take()
                self._ready.clear()
            await self._ready.wait()
