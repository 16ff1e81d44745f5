"""What the tests have in common."""

import itertools
import os
import subprocess
import sys
import textwrap
import unittest

import fipa

_numbers = itertools.count()


def times(usual: int, long: int) -> int:
    """Returns the number of repetitions: `long` if `FIPA_LONG_TESTS` is set."""
    return long if "FIPA_LONG_TESTS" in os.environ else usual


class Case(unittest.TestCase):
    """Two agents in a domain."""

    def setUp(self) -> None:
        self.domain = fipa.Domain()
        self.addCleanup(self._close)
        number = f"{type(self).__name__}_{next(_numbers)}"
        self.rover = self.domain.register(f"rover_{number}").wait()
        self.arm = self.domain.register(f"arm_{number}", type="arm").wait()

    def _close(self) -> None:
        try:
            self.domain.close()
        except fipa.Closed:
            pass

    def inform(self, content: object) -> fipa.Message:
        return fipa.Message("inform", self.arm.name, content)


class Loops(Case, unittest.IsolatedAsyncioTestCase):
    """Two agents in a domain, and an event loop."""


def program(source: str) -> subprocess.Popen:
    """Starts a program of its own in the same domain."""
    # A shell has its background commands ignore Ctrl-C, which programs inherit.
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    source = start + "import sys, time, asyncio, threading, os, fipa\n" + textwrap.dedent(source)
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", source], stdin=pipe, stdout=pipe, stderr=pipe, text=True)


def finished(test: unittest.TestCase, process: subprocess.Popen, expected: int = 0) -> str:
    """Waits for the end of a program, and returns its output."""
    out, errors = process.communicate(timeout=300)
    test.assertEqual(process.returncode, expected, errors)
    return out
