"""Domains, which the end of the interpreter closes."""

from __future__ import annotations

import atexit
import os
import weakref
from collections.abc import Mapping
from typing import Any

from fipa import _native
from fipa._errors import Error

_open: weakref.WeakSet[Domain] = weakref.WeakSet()


class Domain(_native.Domain):
    __doc__ = _native.Domain.__doc__

    def __init__(
        self,
        config: str | os.PathLike[str] | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        # `__new__` has joined the domain.
        _open.add(self)


def _end() -> None:
    for domain in list(_open):
        try:
            domain.close()
        except Error:
            # The program has closed it.
            pass
    _native._ending()


def _forked() -> None:
    _open.clear()
    _native._forked()


# No handler runs any more, and no thread waits for the interpreter when it is gone.
atexit.register(_end)
os.register_at_fork(after_in_child=_forked)
