"""Diagnosis, which command, page, pictures, recording and notebook take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Self

from grounded.diagnosis.parts import Diagnosed
from grounded.diagnosis.pictures import gap_figures
from grounded.diagnosis.telling import LINES, instrument_lines, told
from grounded.figures.figure import Figure
from grounded.result import html_table

UNKNOWABLE = (  # codes of what the trials can't show
    *("model.few", "model.still", "model.unmeasured", "model.share", "model.copy"),
    *("model.joint_friction",),
)


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Diagnosed):
    """The result of a diagnosis, as in `diagnose --json`."""

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Read what `to_json` wrote; findings of other versions are left out."""
        found = super().from_json(document)
        kept = (one for one in found.findings if one.printable and one.code not in LINES)
        return replace(found, findings=tuple(kept))

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return " ".join(told(self).texts(None))

    def to_json(self) -> dict[str, Any]:
        """Return the document of `diagnose --json`, with what its findings say in words."""
        document, told_now = super().to_json(), (*told(self).lines, *self.findings)
        document["verdict"]["sentence"] = self.sentence
        document["findings"] = [one.to_json() for one in told_now]
        document["next_trial"] = self.next_trial
        document["unknowable"] = [one.sentence for one in told_now if one.code in UNKNOWABLE]
        return document

    def figures(self) -> Sequence[Figure]:
        """Return figures: predictions before and after, the credit, where the gap is."""
        return gap_figures(self)

    def _repr_html_(self) -> str:
        """Return what is told, with the sensors' faults and the table; the rest is folded."""
        said = told(self)
        parts = [f"<b>{escape(self.kind)}</b>", *(f"<p>{escape(t)}</p>" for t in said.texts())]
        if sensors := instrument_lines(self.preflight):
            items = "".join(f"<li>{escape(line)}</li>" for line in sensors)
            parts.append(f"<b>Sensors</b><ul>{items}</ul>")
        if said.rows:
            parts.append(html_table(said.rows, said.header))
        if said.next:
            parts.append(f"<p><b>Next trial</b>: {escape(said.next)}</p>")
        everything = super()._repr_html_()
        parts.append(f"<details><summary>The whole document</summary>{everything}</details>")
        return "".join(parts)
