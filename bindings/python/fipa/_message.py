"""Messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Union

from fipa._native import Letter, Lock, Membership

# `collections.abc.Buffer` is only in Python 3.12.
Content = Union[str, bytes, bytearray, memoryview, Any]


@dataclasses.dataclass(frozen=True)
class Message:
    """A message (FIPA00061). The agent that sends it is the sender."""

    #: The act, such as `"request"` or `"inform"`. Calls that begin a protocol have a default.
    performative: str = ""
    #: Names of the receivers, or patterns such as `arm_.*`; a text is one receiver.
    receivers: str | Sequence[str] = ()
    #: A text, bytes, or an object with a contiguous buffer, such as an array of numpy.
    content: Content | None = None
    _: dataclasses.KW_ONLY
    #: Names of the agents that get the answers instead of the sender.
    reply_to: str | Sequence[str] = ()
    #: The language of the content.
    language: str | None = None
    #: The encoding of the content.
    encoding: str | None = None
    #: The ontology of the content.
    ontology: str | None = None
    #: The interaction protocol, such as `"fipa-request"`.
    protocol: str | None = None
    #: The conversation identifier.
    conversation_id: str | None = None
    #: The text that an answer has as its `in_reply_to`.
    reply_with: str | None = None
    #: The `reply_with` of the message that this one answers.
    in_reply_to: str | None = None
    #: The time by which an answer is due, with a time zone.
    reply_by: datetime | None = None
    #: User-defined parameters.
    parameters: Mapping[str, str] = dataclasses.field(default_factory=dict)
    #: A lock, or the membership in a coalition that the agent leads, whose fences the message carries.
    lock: Lock | Membership | None = None

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Message:
        """Creates the message of a dictionary, such as `to_dict` or JSON has."""
        fields = dict(fields)
        if isinstance(fields.get("reply_by"), str):
            fields["reply_by"] = datetime.fromisoformat(fields["reply_by"])
        return cls(**fields)

    def to_dict(self) -> dict[str, Any]:
        """Returns what is set, in types that JSON has if the content is a text. A lock is left out."""
        return _set(self)


_FIELDS = [field.name for field in dataclasses.fields(Message) if field.name != "lock"]


def _set(message: Message | Letter) -> dict[str, Any]:
    values = {name: getattr(message, name) for name in _FIELDS}
    for name in ("receivers", "reply_to"):
        if not isinstance(values[name], str):
            values[name] = list(values[name])
    if isinstance(values["content"], memoryview):
        values["content"] = message.text if isinstance(message, Letter) else bytes(values["content"])
    if values["reply_by"] is not None:
        values["reply_by"] = values["reply_by"].isoformat()
    values["parameters"] = dict(values["parameters"])
    return {name: value for name, value in values.items() if value not in (None, "", [], {})}


def letter_to_dict(letter: Letter) -> dict[str, Any]:
    """Returns the parameters of a letter, with its sender."""
    fields = _set(letter)
    if letter.sender is not None:
        fields["sender"] = letter.sender
    return fields
