"""What makes a part of a file unreadable, as a finding; the caller adds where it stands."""

from __future__ import annotations

from typing import Any

from grounded.findings import found


class Bad(Exception):
    """A part of a file can't be read.

    `code` is its entry in the catalogue, in the area `file` unless it says another.
    """

    def __init__(self, code: str, *about: str, **facts: Any) -> None:
        self.finding = found(code if "." in code else f"file.{code}", *about, **facts)
        super().__init__(self.finding.sentence)


class BadRecord(Bad):
    """A record or chunk can't be read."""


class BadSchema(Bad):
    """A definition can't be used."""


class BadPath(Bad):
    """A path does not fit the message type."""


class BadMessage(Bad):
    """A message's bytes don't match its schema; `message` is its index in the batch."""

    def __init__(self, message: int, code: str, **facts: Any) -> None:
        self.message = int(message)
        super().__init__(code, **facts)
