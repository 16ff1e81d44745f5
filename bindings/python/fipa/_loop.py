"""How event loops wait for the values of the library."""

from __future__ import annotations

import asyncio
import itertools
import weakref
from collections.abc import Generator
from typing import Any

from fipa._native import Pending, _Wakeups

#: Number of values after which a loop takes a turn for its other work.
_TURN = 64


class _Reactor:
    """Resumes the coroutines of one event loop whose values have advanced.

    It carries no value: a coroutine that is resumed asks the library itself. One that is cancelled before has taken
    nothing, so no letter is lost.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.wakeups = _Wakeups()
        self.waiting: dict[int, asyncio.Future[None]] = {}
        self.tags = itertools.count()
        #: Number of the values until the next turn of the loop.
        self.left = _TURN
        loop.add_reader(self.wakeups.fileno(), self._turn)

    def _turn(self) -> None:
        self.left = _TURN
        for tag in self.wakeups.take(_TURN):
            future = self.waiting.get(tag)
            if future is not None and not future.done():
                future.set_result(None)


_reactors: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, _Reactor] = weakref.WeakKeyDictionary()


def drive(pending: Pending[Any]) -> Generator[Any, None, Any]:
    """Waits for a value in the running event loop."""
    loop = asyncio.get_running_loop()
    reactor = _reactors.get(loop)
    if reactor is None:
        reactor = _reactors[loop] = _Reactor(loop)
    reactor.left -= 1
    if reactor.left <= 0:
        # A program whose values are always there must not keep the loop from its other work.
        reactor.left = _TURN
        yield
    tag = next(reactor.tags)
    try:
        while (value := pending._poll(reactor.wakeups, tag)) is None:
            reactor.waiting[tag] = loop.create_future()
            yield from reactor.waiting[tag]
        return value[0]
    except BaseException:
        # Cancelled, or failed.
        pending._abandon()
        raise
    finally:
        reactor.waiting.pop(tag, None)


async def enter(pending: Pending[Any]) -> Any:
    """Enters the block of a value."""
    value = await pending
    pending._entered(value)
    return value


async def itself(value: Any) -> Any:
    """Enters the block of a value that is there."""
    return value


async def nothing() -> None:
    """The end of the block of a value."""
