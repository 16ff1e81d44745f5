"""Many goals with random cancels and kills of either side; the log of the server is the witness.

    soak.py [GOALS] [SEED]

Each goal has exactly one outcome, which is that of the log, or gone if the server died. No goal runs twice. A goal whose
client was killed is canceled.
"""

import json
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from typing import Any

from fipa.ros2.robots import goal_id
from support import LONG, Robot, Site, until

MAPPING = 'actions = ["/crex/count_up"]\n'

#: Number of goals at the same time.
AT_ONCE = 8


class Soak:
    def __init__(self, site: Site) -> None:
        self.site = site
        self.robot = site.robot("crex")
        self.bridge = site.bridge(MAPPING)
        self.lives = 0
        self.outcomes: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.longest = 0.0
        self.until_mapped()

    def until_mapped(self) -> None:
        self.lives += 1
        until(lambda: self.bridge.log.read_text().count("/crex/count_up is ") == self.lives, "the mapping")

    def round(self, first: int) -> None:
        """Runs some goals, and compares their outcomes with the log."""
        goals = {number: self.started(number) for number in range(first, first + AT_ONCE)}
        time.sleep(random.uniform(0.0, 1.5))
        killed = set()
        for number, process in goals.items():
            fate = random.random()
            if fate < 0.2:
                process.send_signal(signal.SIGINT)
            elif fate < 0.35:
                process.kill()
                killed.add(number)
        killed_at = time.monotonic()
        has_died = random.random() < 0.1
        if has_died:
            self.robot.kill()
        outcomes = {number: outcome(process, number in killed) for number, process in goals.items()}
        names = {number: goal_id(f"soak-{number}", "goal").hex for number in goals}
        if not has_died:
            steps = until(lambda: over(self.robot, set(names.values())), "the end of all goals")
            if killed:
                self.longest = max(self.longest, time.monotonic() - killed_at)
        else:
            steps = self.robot.steps()
            self.robot = self.site.robot("crex")
            self.until_mapped()
        for number, kind in outcomes.items():
            self.outcomes[kind] += 1
            log = steps.get(names[number], [])
            allowed = {
                "succeeded": [["started", "succeeded"]],
                "aborted": [["started", "aborted"]],
                # Also one that the server aborts before it sees the cancel.
                "canceled": [["started", "canceled"], ["started", "aborted"], []],
                "client killed": [["started", "canceled"], ["started", "succeeded"], ["started", "aborted"], []],
            }.get(kind, [])
            # A goal whose server does not confirm a cancel ends as cancelled after five seconds.
            if has_died and kind in ("gone", "client killed", "canceled"):
                allowed = [["started"], ["started", "succeeded"], ["started", "canceled"], ["started", "aborted"], []]
            if log not in allowed:
                self.wrong.append(f"goal {number}: {kind}; log: {log}; server died: {has_died}")

    def started(self, number: int) -> "subprocess.Popen[str]":
        command = ("fipa", "do", "crex", "count_up", f"order={random.randrange(3, 50)}")
        named = ("--agent", f"soak-{number}", "--id", "goal")
        return self.site.start(*command, *named, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def over(robot: Robot, names: set[str]) -> Any:
    """The steps of all goals, if none of these is running."""
    steps = robot.steps()
    return steps if all(len(of) > 1 for name, of in steps.items() if name in names) else None


def outcome(process: "subprocess.Popen[str]", is_killed: bool) -> str:
    _, errors = process.communicate(timeout=LONG)
    if is_killed:
        return "client killed"
    if process.returncode == 0:
        return "succeeded"
    if "has aborted the goal" in errors:
        return "aborted"
    gone = ("the server in ROS has died", "it may have died", "no such agent", "unknown action", "is gone: it has left")
    if any(text in errors for text in gone):
        return "gone"
    return "canceled" if "cancelled" in errors or "canceled" in errors else errors.strip()


def main() -> None:
    goals = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    random.seed(seed := int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    print(f"{goals} goals, seed {seed}")
    site = Site()
    try:
        soak = Soak(site)
        for first in range(0, goals, AT_ONCE):
            soak.round(first)
            if first % 80 == 0:
                print(first, dict(soak.outcomes), soak.wrong[-3:], flush=True)
        print(site.path.joinpath("bridge.log").read_text()[-2000:])
    finally:
        site.close()
    report = {"outcomes": soak.outcomes, "longest_wait_after_kill": soak.longest, "wrong": soak.wrong}
    print(json.dumps(report, indent=1))
    sys.exit(bool(soak.wrong))


if __name__ == "__main__":
    main()
