"""Handlers of conversations and goals."""

from __future__ import annotations

import asyncio
import functools
import inspect
import logging
import queue
import threading
import typing
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from fipa._errors import Closed, Error, Refuse
from fipa._native import Agent, Events, Goal, Task

_log = logging.getLogger("fipa")

_TYPES = {
    bool: "boolean",
    int: "integer",
    float: "number",
    str: "string",
    bytes: "bytes",
    None: "nothing",
    type(None): "nothing",
}


#: Maximum number of plain functions of a server that run at the same time. Others wait.
_MAX_WORKERS = 32


class _Workers:
    """Threads that call handlers. The end of the interpreter does not wait for them, unlike for those of
    `concurrent.futures`: a handler may wait for a letter that never comes.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self._idle = threading.Semaphore(0)
        self._count = 0
        self._is_closed = False
        self._lock = threading.Lock()

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Has a thread call a function."""
        result: Future[Any] = Future()
        with self._lock:
            if self._is_closed:
                # The conversation was taken before the end. The other threads may have ended.
                self._start(_call_for, result, call)
                return result
            self._calls.put((result, call))
            if not self._idle.acquire(blocking=False) and self._count < _MAX_WORKERS:
                self._count += 1
                self._start(self._work)
        return result

    def close(self) -> None:
        """Has the threads end after the calls that were submitted."""
        with self._lock:
            self._is_closed = True
            self._calls.put(None)

    @staticmethod
    def _start(target: Callable[..., None], *arguments: Any) -> None:
        threading.Thread(target=target, args=arguments, name="fipa-handler", daemon=True).start()

    def _work(self) -> None:
        while (submitted := self._calls.get()) is not None:
            _call_for(*submitted)
            del submitted
            self._idle.release()
        # For the next thread.
        self._calls.put(None)


def _call_for(result: Future[Any], call: Callable[[], Any]) -> None:
    if result.set_running_or_notify_cancel():
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)


class Server:
    """Calls a handler for each conversation of a protocol, or each goal of an action, until it is closed."""

    def __init__(self, events: Events[Any], handle: Callable[[Any], Any], handler: Callable[..., Any]) -> None:
        self._events = events
        self._handle = handle
        self._running: set[asyncio.Task[None]] = set()
        self._workers = _Workers()
        #: The handler, so that a decorated function can be called.
        self.__wrapped__ = handler
        self.__name__ = getattr(handler, "__name__", "handler")
        self._thread: threading.Thread | None = None

    def _start(self) -> None:
        """Begins to call the handler, which may use this server at once."""
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            self._thread = threading.Thread(target=self._follow, name="fipa-server", daemon=True)
            self._thread.start()
        else:
            self._task = loop.create_task(self._follow_in_loop())

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.__wrapped__(*arguments, **named)

    def close(self) -> None:
        """Takes no further conversation or goal. Handlers that run go on."""
        self._events.close()
        self._workers.close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _follow(self) -> None:
        try:
            for event in self._events:
                self._workers.submit(functools.partial(self._run, event))
        except Closed:
            pass

    def _run(self, event: Any) -> None:
        asyncio.run(self._guarded(event))

    async def _follow_in_loop(self) -> None:
        try:
            async for event in self._events:
                running = asyncio.get_running_loop().create_task(self._guarded(event))
                # The loop has only weak references to its tasks.
                self._running.add(running)
                running.add_done_callback(self._running.discard)
        except Closed:
            pass

    async def _guarded(self, event: Any) -> None:
        try:
            await self._handle(event)
        except Error as error:
            # The other agent is gone, or has cancelled: a handler cannot change that.
            _log.info("%s: %s", self.__name__, error)
        except Exception:
            _log.exception("%s has failed", self.__name__)

    async def _call(self, handler: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Calls a handler. A plain function runs in a worker, unless this thread is one."""
        if inspect.iscoroutinefunction(handler):
            return await handler(*arguments, **named)
        if self._thread is not None:
            return handler(*arguments, **named)
        return await asyncio.wrap_future(self._workers.submit(functools.partial(handler, *arguments, **named)))


async def _until(stopped: Any, work: Any) -> Any:
    """Does the work, and cancels it when it is to stop."""
    working = asyncio.ensure_future(work)
    stopping = asyncio.ensure_future(_awaited(stopped))
    try:
        await asyncio.wait({working, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            working.cancel()
        return await working
    finally:
        stopping.cancel()
        working.cancel()


async def _awaited(pending: Any) -> Any:
    return await pending


def serve(agent: Agent, protocol: str, handler: Callable[[Task], Any] | None) -> Any:
    """Serves a protocol with a handler: see `Agent.serve`."""
    if handler is None:
        return lambda handler: serve(agent, protocol, handler)

    async def handle(task: Task) -> None:
        try:
            result = await _until(task.cancelled(), server._call(handler, task))
        except Refuse as refusal:
            await task.refuse(str(refusal))
        except asyncio.CancelledError:
            if not task.is_cancelled:
                raise
            if not task.is_over:
                # Confirms the cancel.
                await task.inform("cancelled")
        except Exception as error:
            _log.exception("the handler of %s has failed", protocol)
            if not task.is_over:
                await task.fail(f"{type(error).__name__}: {error}")
        else:
            if not task.is_over:
                await task.inform("" if result is None else result)

    server = Server(agent.tasks(protocol), handle, handler)
    server._start()
    return server


def action(agent: Agent, function: Callable[..., Any] | None, name: str | None, policy: Any) -> Any:
    """Offers a function as an action: see `Agent.action`."""
    if function is None:
        return lambda function: action(agent, function, name, policy)

    async def pursue(goal: Goal) -> None:
        try:
            result = await _until(goal.stopped(), server._call(function, goal, **goal.arguments))
        except asyncio.CancelledError:
            if goal.stop_reason is None:
                raise
            goal.fail(goal.stop_reason)
        except Exception as error:
            _log.exception("the action %s has failed", server.__name__)
            goal.fail(f"{type(error).__name__}: {error}")
        else:
            if goal.stop_reason is None:
                goal.succeed(result)
            else:
                # A function that looks at `stop_reason` returns early.
                goal.fail(goal.stop_reason)

    server = Server(agent.goals(_description(function, name, policy)), pursue, function)
    server._start()
    return server


def _description(function: Callable[..., Any], name: str | None, policy: Any) -> dict[str, Any]:
    """Describes a function as an action."""
    hints = typing.get_type_hints(function)
    parameters = []
    # The first parameter is the goal.
    for parameter in list(inspect.signature(function).parameters.values())[1:]:
        described: dict[str, Any] = {"name": parameter.name, "type": _type(hints.get(parameter.name, Any))}
        if parameter.default is not parameter.empty:
            described["optional"] = True
        parameters.append(described)
    description = {
        "name": name or function.__name__,
        "parameters": parameters,
        "result": _type(hints.get("return", Any)),
        "policy": policy or "reject",
    }
    if function.__doc__:
        description["description"] = inspect.cleandoc(function.__doc__)
    return description


def _type(hint: Any) -> Any:
    """Returns the type of a value for the description of an action."""
    origin = typing.get_origin(hint)
    if origin is typing.Literal:
        return {"choice": {"of": [str(word) for word in typing.get_args(hint)]}}
    if origin in (list, tuple):
        elements = [element for element in typing.get_args(hint) if element is not ...]
        return {"list": {"of": _type(elements[0]) if elements else "any"}}
    return _TYPES.get(hint, "any")
