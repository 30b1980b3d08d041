"""Cache: results by key, all forgotten once they would take more than a bound."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


class Cache(dict[Any, Any]):
    """Results by key.

    Args:
        most: numbers that may be kept.
        least: results that are kept however large they are.
    """

    def __init__(self, most: int, least: int = 1) -> None:
        super().__init__()
        self.most, self.least = most, least

    def made(self, key: Any, make: Callable[[], T], size: int = 0) -> T:
        """Return the result of a key, made if it is not known; `size`: of it, 0 for an array's."""
        found: T | None = self.get(key)
        if found is None:
            found = make()
            if len(self) >= max(self.least, self.most // max(size or getattr(found, "size", 1), 1)):
                self.clear()
            self[key] = found
        return found
