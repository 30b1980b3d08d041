"""Check the facts in a message (names, numbers, keys), whatever its wording."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Any


def holding(*facts: object) -> str:
    """Return a pattern for `pytest.raises(match=...)`: all these whole words, in any order."""
    return "(?s)" + "".join(rf"(?=.*{_word(str(fact))})" for fact in facts)


def holds(text: str, *facts: object) -> bool:
    """Check whether a text has all of these as whole words."""
    return re.match(holding(*facts), text) is not None


def of_code(found: Any, *codes: str) -> list[Any]:
    """Return the findings of a result, or of a collection, with one of these codes."""
    some: Iterable[Any] = getattr(found, "findings", found)
    return [one for one in some if any(fnmatchcase(one.code, code) for code in codes)]


def _word(fact: str) -> str:
    before = r"(?<!\w)" if re.match(r"\w", fact) else ""
    after = r"(?!\w)" if re.search(r"\w$", fact) else ""
    return before + re.escape(fact) + after
