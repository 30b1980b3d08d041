"""Base classes of results: a JSON document, and a table and a plot for notebooks.

`Result` is the base class. A `Document` is a result whose fields are the keys of its JSON document,
so that it can be read back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cache
from math import isfinite
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Self, Union, get_args, get_origin, get_type_hints

from grounded.errors import GroundedError

if TYPE_CHECKING:
    from grounded.figures import Figure

SCALED = ("m", "rad", "s")  # units that may get the prefixes m and µ, as may their rates
PREFIX_BELOW = 1e-3  # values below this get a prefix
FIXED = 1e-4  # values from here on are shown without a power of ten when they are compared
ROUNDING = 1e-9  # share of its scale below which a number is what rounding left of 0
UNSEEN = 0.005  # of a standard deviation: a smaller value is 0 in two digits of it
# exceptions that reading a malformed document may raise
MALFORMED = (ValueError, TypeError, AttributeError, KeyError, OverflowError, RecursionError)


def figure(value: float | None, digits: int = 4) -> str:
    """Format a value in significant digits; "failed" for minus infinity, "-" for None or NaN."""
    if value is None or math.isnan(value):
        return "-"
    if value == 0:
        return "0"
    if value == -math.inf:
        return "failed"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:,.{decimals}f}"


def spread(std: float) -> str:
    """Format a standard deviation in two digits, without a power of ten down to 1e-6."""
    if not 1e-6 <= std < 1e-3:
        return figure(std, 2)
    return f"{std:.{1 - math.floor(math.log10(std))}f}"


def with_error(value: float, error: float) -> str:
    """Format a value to the second digit of its error: `0.0014 +- 0.0012`, `-12.3 +- 1.2`."""
    if not 1e-9 < error < 1e4:
        return f"{figure(value, 3)} +- {figure(error, 2)}"
    decimals = max(1 - math.floor(math.log10(error)), 0)
    return f"{round(value, decimals) + 0.0:.{decimals}f} +- {error:.{decimals}f}"


def listed(names: Iterable[str]) -> str:
    """Join names as in `a`, `a and b` or `a, b and c`."""
    *most, last = [*names] or [""]
    return f"{', '.join(most)} and {last}" if most else last


def or_zero(value: float, *scale: float) -> float:
    """Return 0 for a value that is rounding noise beside the numbers that it belongs to.

    Args:
        value: a number to be shown, such as one end of a range.
        scale: others of its kind and unit, such as the other end, or its standard deviation.
    """
    size = max(map(abs, filter(isfinite, scale)), default=0.0)
    return 0.0 if abs(value) <= ROUNDING * size else value


def seen(value: float, std: float) -> float:
    """Return 0 for a value that two digits of its standard deviation don't show."""
    return 0.0 if abs(value) < UNSEEN * std < math.inf else value


def extent(low: float, high: float) -> tuple[float, float]:
    """Return the ends of a range, 0 for one that is rounding noise beside the other."""
    return or_zero(low, high), or_zero(high, low)


def percent(share: float) -> str:
    """Format a share as a percentage, with one decimal below 10 % and from 90 to 100 %."""
    if math.isnan(share):
        return "-"
    value = 100 * share if abs(share) >= 5e-4 or share > 0 else 0.0
    if 0 < value < 0.05 or 99.95 <= value < 100:
        return "< 0.1 %" if value < 50 else "> 99.9 %"
    return f"{value:.0f} %" if 10 <= value <= 90 or value >= 100 else f"{value:.1f} %"


def number(value: float) -> str:
    """Format a number in three significant digits; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def shown(unit: str) -> str:
    """Return the unit as shown: no "1" but above a stroke, since it would look like a digit."""
    return "" if unit == "1" else re.sub(r"/1(?![\w.^])", "", unit)


def begun(text: str) -> str:
    """Return a text with a capital letter, unless it begins with a name: `delay:u`, `t_end`."""
    first = text.partition(" ")[0]
    return text if ":" in first or "_" in first else f"{text[:1].upper()}{text[1:]}"


def per_second(unit: str) -> str:
    """Return the unit of a rate of change: rad/s for rad, m/s^2 for m/s, 1/s for 1."""
    if found := re.fullmatch(r"(.*)/ ?s(?:\^(\d+))?", unit):
        return f"{found[1]}/s^{int(found[2] or 1) + 1}"
    return f"{unit} per s" if "/" in unit else f"{unit or '1'}/s"


def with_unit(text: str, unit: str) -> str:
    """Join a number and its unit."""
    return f"{text} {shown(unit)}".rstrip()


def measured(value: float, unit: str) -> str:
    """Format an error in two digits, in mm, mrad ... where it is small in its own unit."""
    return _told(value, *_scale(value, unit))


def measured_alike(values: Sequence[float], unit: str) -> list[str]:
    """Format errors that are compared, like `measured`, in the unit of their geometric mean."""
    total, count, found = 0.0, 0, list[float]()
    for value in values:
        found.append(or_zero(value, *values))
        if 0 < found[-1] < math.inf:
            total, count = total + math.log(found[-1]), count + 1
    scale = _scale(math.exp(total / count) if count else 0.0, unit)
    return [_told(value, *scale, FIXED) for value in found]


def _scale(value: float, unit: str) -> tuple[float, str]:
    """Return the factor and the scaled unit for values of this size; lengths below 1 m are in mm.

    With cm between mm and m, two lines on one motion were in two units.
    """
    if unit == "m" and PREFIX_BELOW <= value < 1.0:
        return 1e3, "mm"
    if unit.startswith(SCALED) and 0 < value < PREFIX_BELOW:
        step = 1 if value >= 1e-5 else 2
        return 1e3**step, "-mµ"[step] + unit
    return 1.0, unit


def _told(value: float, scale: float, unit: str, least: float = PREFIX_BELOW) -> str:
    """Format a value in two digits with its unit, without a power of ten from `least` on."""
    value *= scale
    shape = ",.0f" if 9.95 <= value < 1e6 else "#.2g" if least <= value < 1e6 else ".1e"
    text = "-" if math.isnan(value) else f"{value:{shape}}" if value else "0"
    return with_unit(text, unit)


UNSAID: Mapping[str, Any] = {"key": ""}  # metadata of a field that is not written to JSON
NULL: Mapping[str, Any] = {"null": True}  # of a field whose empty value is null in JSON


class Result:
    """Base class of results (frozen dataclasses with `repr=False`), with display in notebooks."""

    def summary(self) -> str:
        """Return a short summary, such as the name and the utility."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """The sentences of its findings, if it has any."""
        return tuple(one.sentence for one in getattr(self, "findings", ()))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.summary()}".rstrip() + ">"

    def to_json(self) -> dict[str, Any]:
        """Return the document that the command's --json prints; None for non-finite numbers."""
        raise NotImplementedError

    def figures(self) -> Sequence[Figure]:
        """Return the figures of this result, which may be none."""
        return ()

    def plot(self) -> Any:
        """Return a Plotly figure for notebooks (extra `notebook`).

        Raises:
            GroundedError: if there is nothing to draw, or Plotly is not installed.
        """
        from grounded.figures import notebook_figure

        figures = self.figures()
        if not figures:
            raise GroundedError(f"this {type(self).__name__} has no picture; print it")
        return notebook_figure(figures)

    def _repr_html_(self) -> str:
        """Return the document as an HTML table, for Jupyter."""
        return f"<b>{type(self).__name__}</b>{_table(self.to_json())}"


def document(**values: Any) -> dict[str, Any]:
    """Return a JSON document with these keys, its values converted by `plain`."""
    return {key: plain(value) for key, value in values.items()}


@dataclass(frozen=True, eq=False, repr=False)
class Document(Result):
    """Base class of frozen dataclasses that are written to JSON field by field and read back.

    A field's metadata may set the JSON `key` ("": the field is not written), `brief`, which omits
    the key if the value is None, not finite or "", or `null`. The properties in `ALSO` are written,
    too. Two documents are equal if their JSON is equal; numbers that are not finite are null there.
    """

    ALSO: ClassVar[tuple[str, ...]] = ()

    def summary(self) -> str:
        """Return the first two fields: mostly a name, and a file."""
        return ", ".join(str(getattr(self, one.name)) for one in fields(self)[:2])

    def to_json(self) -> dict[str, Any]:
        """Return the fields by JSON key."""
        found = {}
        for one in fields(self):
            value = getattr(self, one.name)
            nothing = value in (None, "") or (isinstance(value, float) and not isfinite(value))
            key = one.metadata.get("key", one.name)
            if key and not (one.metadata.get("brief") and nothing):
                found[key] = plain(value or None if one.metadata.get("null") else value)
        return found | {name: plain(getattr(self, name)) for name in self.ALSO}

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Read what `to_json` wrote; null becomes NaN or an empty value.

        A missing key gets the field's default.

        Args:
            document: parsed JSON, which may be from an older version or not valid.

        Raises:
            GroundedError: if the document is malformed.
        """
        try:
            return _read(cls, document)  # type: ignore[no-any-return]
        except MALFORMED as error:
            raise GroundedError(f"not a JSON document of a {cls.__name__}: {error}") from None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.to_json() == other.to_json()


@cache
def _types(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _read(kind: Any, value: Any) -> Any:
    """Convert a JSON value to the type of a field; null becomes its empty value."""
    origin, of = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):  # X | None
        optional = isinstance(of[0], type) and issubclass(of[0], Document)
        return None if optional and not value else _read(of[0], value)
    if kind is Any:
        return value
    if kind is float:
        return math.nan if value is None else float(value)
    if origin is tuple and of[-1] is Ellipsis:
        return tuple(_read(of[0], item) for item in value or ())
    if origin is tuple:
        items = [None] * len(of) if value is None else value
        return tuple(_read(one, item) for one, item in zip(of, items, strict=True))
    if origin is Mapping:
        return {str(key): _read(of[1], item) for key, item in (value or {}).items()}
    if issubclass(kind, Document):
        return kind(**_given(kind, {} if value is None else dict(value)))
    if reads := getattr(kind, "from_json", None):
        return reads(value)
    return kind() if value is None else kind(value)  # str, int, bool


def _given(kind: Any, document: dict[str, Any]) -> dict[str, Any]:
    """Return the field values that a document holds, by field name."""
    found = {}
    for one in fields(kind):
        key = one.metadata.get("key", one.name)
        if key and key in document:
            found[one.name] = _read(_types(kind)[one.name], document[key])
        elif one.default is MISSING and one.default_factory is MISSING:
            raise ValueError(f"it has no '{key}'")
    return found


def plain(value: Any) -> Any:
    """Convert a value for JSON: arrays to lists, results to dicts, NaN and infinity to None.

    Args:
        value: nested mappings, sequences, arrays, numbers, strings; anything else becomes its
            `str`.
    """
    if hasattr(value, "to_json"):
        return value.to_json()
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


def html_table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Return an HTML table of texts, for notebooks."""
    from html import escape

    head = "".join(f"<th style='text-align:left'>{escape(cell)}</th>" for cell in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _table(value: Any) -> str:
    from html import escape

    if isinstance(value, dict):
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(key)}</th><td>{_table(item)}</td></tr>"
            for key, item in value.items()
            if item not in (None, [], {}, "")
        )
        return f"<table>{rows}</table>"
    if isinstance(value, list | tuple):
        shown = [_table(item) for item in value[:12]]
        return "<br>".join(shown + ["..."] * (len(value) > 12))
    if isinstance(value, float):
        return "-" if math.isnan(value) else escape(f"{value:.4g}")
    return escape(str(value))
