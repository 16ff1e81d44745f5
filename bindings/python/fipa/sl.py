"""Content in the language SL (FIPA00008), as values of Python.

Numbers, texts, truth values, lists and dictionaries have the form that the command `fipa` shows in JSON.
"""

from fipa._native import sl_dumps as dumps
from fipa._native import sl_loads as loads

__all__ = ["dumps", "loads"]
