"""Processes of the tests: a domain, robots of ROS, and bridges between them."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fipa

HERE = Path(__file__).parent

#: Maximum wait for what must happen, in seconds. A test that passes does not wait for it.
LONG = 60.0

_CONFIGURATION = """
[mts]
transports = ["shm", "unix"]
[discovery]
mdns = false
"""


def until(happened: Callable[[], Any], what: str) -> Any:
    """Waits until a function returns something true, and returns that."""
    end = time.monotonic() + LONG
    while not (result := happened()):
        if time.monotonic() > end:
            raise AssertionError(f"{what} did not happen in {LONG:.0f} s")
        time.sleep(0.05)
    return result


def ros_domain() -> tuple[int, socket.socket]:
    """Returns a domain of ROS that no other test has until the socket is closed."""
    # Above 101, the ports of Fast DDS are those that the system gives to clients.
    for number in range(1, 102):
        place = socket.socket(socket.AF_UNIX)
        try:
            place.bind(f"\0fipa-test-ros-domain-{number}")
            return number, place
        except OSError:
            place.close()
    raise AssertionError("no domain of ROS is free")


class Site:
    """A domain of agents and a graph of ROS of its own."""

    def __init__(self) -> None:
        self._directory = tempfile.TemporaryDirectory()
        self.path = Path(self._directory.name)
        self.config = self.path / "fipa.toml"
        self.config.write_text(f'domain = "ros2-{os.getpid()}"\nruntime_dir = "{self.path}/run"\n' + _CONFIGURATION)
        number, self._place = ros_domain()
        self.environment = {
            **os.environ,
            "FIPA_CONFIG": str(self.config),
            "ROS_DOMAIN_ID": str(number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(self.path / "log"),
        }
        os.environ.update(self.environment)
        self._running: list[subprocess.Popen[Any]] = []

    def close(self) -> None:
        for process in self._running:
            kill(process)
        # A process that joins removes what killed ones have left.
        fipa.Domain(self.config).close()
        self._directory.cleanup()
        self._place.close()

    def start(self, *command: str, **options: Any) -> "subprocess.Popen[str]":
        process = subprocess.Popen(command, env=self.environment, text=True, **options)
        self._running.append(process)
        return process

    def robot(self, namespace: str) -> "Robot":
        return Robot(self, namespace)

    def talker(self, *arguments: str, **options: Any) -> "subprocess.Popen[str]":
        return self.start(sys.executable, str(HERE / "talker.py"), *arguments, **options)

    def bridge(self, mapping: str, *arguments: str, name: str = "bridge") -> "Bridge":
        return Bridge(self, mapping, arguments, name)

    def fipa(self, *arguments: str, input: str | None = None) -> "subprocess.CompletedProcess[str]":
        """Runs the command `fipa` to its end."""
        command = ["fipa", *arguments]
        return subprocess.run(
            command, env=self.environment, text=True, input=input, capture_output=True, timeout=LONG, check=False
        )


def kill(process: "subprocess.Popen[Any]") -> None:
    process.kill()
    process.wait()


class Robot:
    """A robot of ROS, `robot.py`, and its log."""

    def __init__(self, site: Site, namespace: str) -> None:
        self.log = site.path / f"{namespace}.log"
        self.log.touch()
        self.process = site.start(sys.executable, str(HERE / "robot.py"), namespace, str(self.log))
        self._seen = 0

    def lines(self) -> list[list[str]]:
        return [line.split(" ", 1) for line in self.log.read_text().splitlines()]

    def steps(self) -> dict[str, list[str]]:
        """The steps of each goal."""
        steps: dict[str, list[str]] = {}
        for name, step in self.lines():
            steps.setdefault(name, []).append(step)
        return steps

    def kill(self) -> None:
        kill(self.process)


class Bridge:
    """A bridge, and its log."""

    def __init__(self, site: Site, mapping: str, arguments: tuple[str, ...], name: str) -> None:
        file = site.path / f"{name}.toml"
        file.write_text(mapping)
        self.log = site.path / f"{name}.log"
        with self.log.open("a") as log:
            self.process = site.start(sys.executable, "-m", "fipa.ros2", str(file), *arguments, stdout=log, stderr=log)

    def has_logged(self, text: str) -> bool:
        return text in self.log.read_text()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(LONG)

    def kill(self) -> None:
        kill(self.process)
