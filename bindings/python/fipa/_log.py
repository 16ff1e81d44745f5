"""Log lines of the library."""

from __future__ import annotations

import logging
import threading

from fipa import _native

_logger = logging.getLogger("fipa")


_starting = threading.Lock()
_thread: threading.Thread | None = None


def start() -> int:
    """Starts the thread that logs the lines, and returns the level from which lines are of use."""
    global _thread
    with _starting:
        if _thread is None:
            thread = threading.Thread(target=_native._follow_log, name="fipa-log", daemon=True)
            try:
                thread.start()
                _thread = thread
            except RuntimeError:
                # The interpreter ends, or the system refuses a thread. The lines wait for calls.
                pass
    return _logger.getEffectiveLevel()


def emit(lines: list[tuple[int, str, str]], missed: int) -> None:
    """Logs the lines that have waited."""
    for number, name, text in lines:
        logging.getLogger(name).log(number, "%s", text)
    if missed:
        _logger.warning("%d older lines were dropped: there were too many at once", missed)
