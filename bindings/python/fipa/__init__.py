"""Agents of robots: communication to the FIPA standards.

    import fipa

    with fipa.Domain() as domain:
        rover = domain.register("rover").wait()
        rover.send(fipa.Message("request", "arm_1", "(lift crate)")).wait()
        print(rover.receive().wait(timeout=5).text)

What a program waits for is a `Pending`: a coroutine awaits it (`await rover.receive()`), and other programs call
`wait()`.
"""

from fipa import sl
from fipa._domain import Domain
from fipa._errors import (
    Cancelled,
    Closed,
    Error,
    Forked,
    Gone,
    Interrupted,
    Invalid,
    Lost,
    NameTaken,
    NotDelivered,
    Refuse,
    Refused,
    Stale,
    TimedOut,
    TooLarge,
    Violation,
)
from fipa._message import Message
from fipa._native import (
    Agent,
    Bids,
    Coalition,
    Deliveries,
    Events,
    Goal,
    Letter,
    Loan,
    Lock,
    Membership,
    Owned,
    Pending,
    Publisher,
    RemoteGoal,
    Request,
    Task,
    TopicLoan,
)
from fipa._serve import Server

__all__ = [
    "Agent",
    "Bids",
    "Cancelled",
    "Closed",
    "Coalition",
    "Deliveries",
    "Domain",
    "Error",
    "Events",
    "Forked",
    "Goal",
    "Gone",
    "Interrupted",
    "Invalid",
    "Letter",
    "Loan",
    "Lock",
    "Lost",
    "Membership",
    "Message",
    "NameTaken",
    "NotDelivered",
    "Owned",
    "Pending",
    "Publisher",
    "Refuse",
    "Refused",
    "RemoteGoal",
    "Request",
    "Server",
    "Stale",
    "Task",
    "TimedOut",
    "TooLarge",
    "TopicLoan",
    "Violation",
    "sl",
]
