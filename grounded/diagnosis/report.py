"""Diagnosis, which command, page, pictures, recording and notebook take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from grounded.diagnosis.parts import Diagnosed
from grounded.diagnosis.pictures import gap_figures
from grounded.diagnosis.tables import as_html
from grounded.figures.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Diagnosed):
    """The result of a diagnosis, as in `diagnose --json`."""

    def figures(self) -> Sequence[Figure]:
        """Return figures: predictions before and after, the credit, where the gap is."""
        return gap_figures(self)

    def _repr_html_(self) -> str:
        return as_html(self, super()._repr_html_())
