"""Entry: the words of one finding; note, warn, aside and refuse make one of that weight."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple


class Entry(NamedTuple):
    """The words of one code.

    Attributes:
        weight: one of `WEIGHTS`, which says what it means.
        short: what was found, a clause without a full stop.
        remedy: what to do about it, "" for nothing.
        hides: codes of findings that follow from it.
    """

    weight: str
    short: str
    remedy: str = ""
    hides: tuple[str, ...] = ()


note, warn = partial(Entry, "note"), partial(Entry, "warn")
aside, refuse = partial(Entry, "aside"), partial(Entry, "refuse")
