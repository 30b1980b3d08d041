"""Diagnosis, which command, page, pictures, recording and notebook take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any, Self

from grounded.diagnosis.parts import Diagnosed
from grounded.diagnosis.pictures import gap_figures
from grounded.diagnosis.tables import instrument_lines
from grounded.diagnosis.telling import told
from grounded.figures.figure import Figure
from grounded.result import html_table

UNKNOWABLE = (  # codes of what the trials can't show
    *("model.one_trial", "model.few_steps", "model.still", "model.unmeasured", "model.stretches"),
    *("model.share", "model.copy", "model.joint_friction", "gap.not_compared"),
)


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Diagnosed):
    """The result of a diagnosis, as in `diagnose --json`."""

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Read what `to_json` wrote; findings of other versions are left out."""
        found = super().from_json(document)
        return replace(found, findings=tuple(one for one in found.findings if one.printable))

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return " ".join(told(self).texts(None))

    def to_json(self) -> dict[str, Any]:
        """Return the document of `diagnose --json`, with what its findings say in words."""
        document, verdict = super().to_json(), self.verdict.to_json()
        unknowable = [one.sentence for one in self.findings if one.code in UNKNOWABLE]
        return {"verdict": verdict | {"sentence": self.sentence}} | {
            key: value for key, value in document.items() if key != "verdict"
        } | {"next_trial": self.next_trial, "unknowable": unknowable}  # fmt: skip

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
