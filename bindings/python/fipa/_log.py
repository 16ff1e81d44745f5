"""Log lines of the library."""

from __future__ import annotations

import logging

_logger = logging.getLogger("fipa")


def level() -> int:
    """Returns the level from which lines are of use."""
    return _logger.getEffectiveLevel()


def emit(lines: list[tuple[int, str, str]], missed: int) -> None:
    """Logs the lines that have waited for a call."""
    for number, name, text in lines:
        logging.getLogger(name).log(number, "%s", text)
    if missed:
        _logger.warning("%d older lines were dropped: the program made no call for too long", missed)
