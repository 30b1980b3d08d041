"""The picture of each of the paper's studies, drawn as the page draws its figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError
from grounded_trials.figures import Figure
from grounded_trials.figures_png import png
from grounded_trials.store import write_atomically
from grounded_trials.study_bars import (
    baselines_figure,
    estimated_figure,
    fit_car_figure,
    footnote9_figure,
    nondeterminism_figure,
)
from grounded_trials.study_paths import car_figure, flight_figure
from grounded_trials.study_trends import noise_figure, theorem1_figure

PICTURES: dict[str, Callable[[Any], Figure]] = {
    "flight": flight_figure,
    "car": car_figure,
    "fit-car": fit_car_figure,
    "estimated": estimated_figure,
    "nondeterminism": nondeterminism_figure,
    "footnote9": footnote9_figure,
    "theorem1": theorem1_figure,
    "baselines": baselines_figure,
    "noise": noise_figure,
}


def draw_study(name: str, result: Any, path: Path) -> None:
    """Writes the picture of a study's result as a PNG file.

    Args:
        name: of the study, as in `grounded experiment NAME`.
        result: what its function returned.
        path: of the file; its folder is made.

    Raises:
        GroundedError: if the name is unknown or the file can't be written.
    """
    if name not in PICTURES:
        raise GroundedError(f"no picture of '{name}', only of {', '.join(PICTURES)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GroundedError(f"{path.parent} can't be made: {error.strerror}") from None
    write_atomically(path, png(PICTURES[name](result)))
