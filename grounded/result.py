"""What every result offers: one JSON document, and a table of it for a notebook."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class Result:
    """Base of frozen results, dataclasses with `repr=False`: what a notebook shows of them."""

    def summary(self) -> str:
        """What it is, in a few words: its name, its utility."""
        return ""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.summary()}".rstrip() + ">"

    def to_json(self) -> dict[str, Any]:
        """What the command's --json prints: finite numbers, None where there is none."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """The document as a table, for Jupyter."""
        return f"<b>{type(self).__name__}</b>{_table(self.to_json())}"


def document(**values: Any) -> dict[str, Any]:
    """A document of these keys, `plain`."""
    return {key: plain(value) for key, value in values.items()}


def plain(value: Any) -> Any:
    """A value as JSON can hold it: arrays as lists, NaN and infinity as None.

    Args:
        value: nested mappings, sequences, arrays, numbers, strings; anything else by its `str`.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | str) or value is None:
        return value
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)


def _table(value: Any) -> str:
    from html import escape

    if isinstance(value, dict):
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(key)}</th><td>{_table(item)}</td></tr>"
            for key, item in value.items()
            if item not in (None, [], {}, "")
        )
        return f"<table>{rows}</table>"
    if isinstance(value, list):
        shown = [_table(item) for item in value[:12]]
        return "<br>".join(shown + ["..."] * (len(value) > 12))
    return escape(f"{value:.4g}" if isinstance(value, float) else str(value))
