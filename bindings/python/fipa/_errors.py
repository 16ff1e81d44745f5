"""The exceptions of `fipa`."""


class Error(Exception):
    """An operation has failed."""


class Invalid(Error, ValueError):
    """A name, a number or a configuration is wrong."""


class Closed(Error):
    """The agent was deregistered, the domain was closed, or the conversation has ended."""


class Forked(Error):
    """This process was forked from one that uses `fipa`."""


class TimedOut(Error, TimeoutError):
    """The time limit is over."""


class NotDelivered(Error):
    """A letter was not delivered to each of its receivers. The text has the outcome for each."""


class Refused(Error):
    """The other agent refuses, fails, or does not understand."""


class Gone(Error):
    """The other agent is gone, or its host is silent."""


class Cancelled(Error):
    """The conversation was cancelled."""


class Violation(Error):
    """A message violates its protocol."""


class Lost(Error):
    """The lock was lost or released."""


class TooLarge(Error):
    """The letter or the content is too large."""


class NameTaken(Error):
    """Another agent has the name."""


class Stale(Error):
    """A fence is missing, or is not the live one."""


class Interrupted(Error):
    """A subscription is interrupted, and goes on when the publisher returns."""


class Refuse(Exception):
    """A handler raises it to refuse a request, with the reason."""
