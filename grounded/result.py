"""What every result offers: one JSON document, and a table of it for a notebook."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any


class Result:
    """Base of frozen results: `to_json` gives the document that the command's --json prints."""

    def to_json(self) -> dict[str, Any]:
        """Plain dicts, lists, strings and finite numbers; None where there is no number."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """The document as a table, for Jupyter."""
        return f"<b>{escape(type(self).__name__)}</b>{_table(self.to_json())}"


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
