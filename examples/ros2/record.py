"""Runs the whole example, each program in a terminal of its own, and draws the terminals at the end.

    python3 record.py ros2.svg

The book has the picture.
"""

import html
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

HERE = Path(__file__).parent

#: Width of a terminal in characters, and their size in pixels.
COLUMNS, WIDE, HIGH = 90, 7.83, 18

ROBOTS = {"crex": 2.0, "daisy": 9.0}


class Terminal:
    """The programs of a terminal, one after the other, and all that they print."""

    def __init__(self) -> None:
        self._text = ""
        self.running: subprocess.Popen[bytes] | None = None

    def start(self, line: str) -> subprocess.Popen[bytes]:
        self._text += f"$ {line}\n"
        line = line.replace("python3", shlex.quote(sys.executable))
        line = re.sub("^fipa-ros2", f"{shlex.quote(sys.executable)} -m fipa.ros2", line)
        ours, theirs = pty.openpty()
        # A session of its own, in which Ctrl-C works as in a terminal.
        self.running = subprocess.Popen(
            shlex.split(line), cwd=HERE, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)
        threading.Thread(target=self._read, args=[ours], daemon=True).start()
        return self.running

    def _read(self, ours: int) -> None:
        try:
            while some := os.read(ours, 4096):
                self._text += some.decode(errors="replace")
        except OSError:
            # The program has ended.
            os.close(ours)

    def until(self, text: str) -> None:
        end = time.monotonic() + 60
        while text not in self._text:
            if time.monotonic() > end:
                sys.exit(f"{text!r} is missing: {self._text}")
            time.sleep(0.05)

    def stop(self) -> None:
        if self.running is not None and self.running.poll() is None:
            self.running.send_signal(signal.SIGINT)
            try:
                self.running.wait(10)
            except subprocess.TimeoutExpired:
                self.running.kill()

    def lines(self) -> list[str]:
        """The lines as a terminal shows them."""
        text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self._text).replace("\r\n", "\n")
        shown = [line.rsplit("\r", 1)[-1].rstrip() for line in text.split("\n")]
        return [line[at : at + COLUMNS] for line in shown if line for at in range(0, len(line), COLUMNS)]


def drawn(terminals: list[Terminal]) -> str:
    width, y, parts = COLUMNS * WIDE + 32, 8.0, []
    for terminal in terminals:
        lines = terminal.lines()
        parts.append(
            f'<rect x="4" y="{y:g}" width="{width - 8:g}" height="{len(lines) * HIGH + 16}" rx="6" fill="#161b22"/>'
        )
        for number, line in enumerate(lines, 1):
            color = "#7ee787" if line.startswith("$ ") else "#e6edf3"
            at = f'x="16" y="{y + number * HIGH + 2:g}"'
            parts.append(f'<text {at} fill="{color}" xml:space="preserve">{html.escape(line)}</text>')
        y += len(lines) * HIGH + 24
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {y:g}" role="img" font-size="13" '
        'font-family="DejaVu Sans Mono, Menlo, Consolas, monospace">'
    )
    title = "<title>The bridge, the owner of the passage, the bidders and the dispatcher</title>"
    return "\n".join([head, title, *parts, "</svg>\n"])


def main(file: Path) -> None:
    robots, (bridge, door, bidder, desk) = [Terminal() for _ in ROBOTS], [Terminal() for _ in range(4)]
    try:
        for terminal, (name, x) in zip(robots, ROBOTS.items(), strict=True):
            terminal.start(f"python3 navigator.py --ros-args -r __ns:=/{name} -p x:={x}")
        bridge.start("fipa-ros2 robots.toml")
        for name in ROBOTS:
            bridge.until(f"/{name}/navigate is ")
            bridge.until(f"/{name}/pose is ")
        door.start("fipa own passage --agent door --forget")
        door.until("is owned")
        bidder.start("python3 bidder.py crex daisy")
        bidder.until("bidding")
        for line in ("python3 dispatcher.py 6", "fipa do crex navigate order=10"):
            desk.start(line).wait(60)
        door.until("released")
        desk.until("fence")
        file.write_text(drawn([bridge, door, bidder, desk]))
    finally:
        for terminal in (desk, bidder, door, bridge, *robots):
            terminal.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
