"""The leader in Python. Usage: lead.py NAME PARTNER"""

import sys
from collections.abc import Callable
from itertools import cycle
from typing import Any

import fipa

# Time limits in seconds: one that no step reaches, and one that passes.
LONG, SHORT = 60, 3


def step(name: str, observed: object) -> None:
    print(f"{name}: {str(observed).lower() if isinstance(observed, bool) else observed}", flush=True)


def fails(name: str, call: Callable[[], Any]) -> None:
    """Prints the failure of a step that must fail."""
    try:
        call()
        step(name, "no failure")
    except fipa.Error as error:
        step(name, f"{type(error).__name__}: {error}")


def receive(agent: fipa.Agent, conversation: str) -> fipa.Letter:
    """Waits for a letter of a conversation. Others are late messages of conversations that have ended."""
    while (letter := agent.receive().wait()).conversation_id != conversation:
        pass
    return letter


class Leader:
    def __init__(self, agent: fipa.Agent, partner: str) -> None:
        self.agent = agent
        self.partner = partner

    def request(self, content: str, lock: fipa.Lock | None = None) -> fipa.Message:
        return fipa.Message("request", self.partner, content, lock=lock)

    def ask(self, content: str, limit: float = LONG, lock: fipa.Lock | None = None) -> str:
        """Requests an action, and returns the content of the answer."""
        return self.agent.request(self.request(content, lock), timeout=limit).wait().text

    def inform(self, content: str | bytes, conversation: str, **fields: Any) -> fipa.Message:
        return fipa.Message("inform", self.partner, content, conversation_id=conversation, **fields)

    def letters(self) -> None:
        agent = self.agent
        agent.send(self.inform("Grüße, 起重机 🏗", "inform", language="text", reply_with="q1")).wait()
        answer = receive(agent, "inform")
        step("inform", answer.text)
        step("in reply to", answer.in_reply_to)
        step("sender", answer.sender)

        pattern = bytes(range(251))
        loan = agent.loan(self.inform("", "loan"), 1_000_000)
        with memoryview(loan) as memory:
            for at, byte in zip(range(len(memory)), cycle(pattern)):
                memory[at] = byte
        loan.send().wait()
        step("loan", receive(agent, "loan").text)

        content = (pattern * 254_981)[:64_000_000]
        agent.send(self.inform(content, "large")).wait()
        step("large", receive(agent, "large").text)

        unknown = fipa.Message("inform", "missing", "", conversation_id="unknown")
        fails("unknown receiver", lambda: agent.send(unknown, timeout=SHORT).wait())
        step("report", receive(agent, "unknown").performative)

        both = [self.partner, f"{self.partner}_2"]
        agent.send(fipa.Message("inform", both, "both", conversation_id="both")).wait()
        answers = [receive(agent, "both") for _ in both]
        step("multicast", "; ".join(sorted(f"{answer.sender} {answer.text}" for answer in answers)))

    def requests(self) -> None:
        lift = self.agent.begin_request(self.request("lift"), timeout=LONG)
        step("agreed", lift.agreed().wait())
        step("answer", lift.result().wait().text)
        fails("refused", lambda: self.ask("drop"))
        fails("failed", lambda: self.ask("throw"))
        fails("timed out", lambda: self.ask("wait", SHORT))
        wait = self.agent.begin_request(self.request("wait"), timeout=LONG)
        wait.agreed().wait()
        wait.cancel()
        fails("cancelled", lambda: wait.result().wait())

    def goals(self) -> None:
        goal = self.agent.invoke(self.partner, "count", {"to": 7})
        note = next(progress["note"] for progress in goal if progress["note"])
        step("progress", note)
        self.ask("go")
        step("result", goal.result().wait())
        far = self.agent.invoke(self.partner, "count", {"to": "far"})
        fails("wrong goal", lambda: far.result().wait())
        goal = self.agent.invoke(self.partner, "count", {"to": 8})
        next(goal)
        goal.cancel()
        fails("cancelled goal", lambda: goal.result().wait())

    def notifications(self) -> None:
        with self.agent.subscribe(self.partner, "charge", keep="all", timeout=LONG) as charge:
            step("notification", next(charge).text)
            for percent in ["80", "70 ☀"]:
                self.ask(f"publish {percent}")
                step("notification", next(charge).text)

    def locks(self) -> None:
        step("no fence", self.ask("dock"))
        with self.agent.lock("bay", timeout=LONG).wait() as lock:
            step("fence", self.ask("dock", lock=lock))
            step("locked", self.ask("lock 200"))
            own = lock.fence
        late, other = self.ask("lock 60000").split(" ", 1)
        step("late command", late)

        def position(fence: str) -> list[int]:
            return [int(number) for number in fence.split(".")[:2]]

        step("next fence is greater", own is not None and position(other) > position(own))

    def violations(self) -> None:
        """Sends a message that its protocol does not have: with a domain that checks what it sends, and with one that
        does not.
        """
        fields = {"protocol": "fipa-request", "conversation_id": "violation"}
        propose = fipa.Message("propose", self.partner, "", **fields)
        with fipa.Domain(settings={"monitor.check": "enforce"}) as strict:
            other = strict.register(f"{self.agent.name}_strict").wait()
            fails("violation", lambda: other.send(propose).wait())
        self.agent.send(propose).wait()
        step("violation at the partner", receive(self.agent, "violation report").text)


def main(own: str, partner: str) -> None:
    with fipa.Domain() as domain:
        agent = domain.register(own).wait()
        step("register", agent.name)
        try:
            domain.register(partner).wait()
        except fipa.Error as error:
            step("register the partner", type(error).__name__)
        leader = Leader(agent, partner)
        leader.letters()
        leader.requests()
        leader.goals()
        leader.notifications()
        leader.locks()
        leader.violations()
        wait = agent.begin_request(leader.request("wait"))
        step("request without an end", wait.agreed().wait())
        fails("the partner is killed", lambda: wait.result().wait())


main(*sys.argv[1:])
