"""adopt in a workspace: diagnosed effects join the model of grounded.toml, with their values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from grounded.errors import GroundedError, nearest
from grounded_trials.diagnosis_file import FILE
from grounded_trials.toml_edit import set_in_model
from grounded_trials.workspace import Workspace

Effect = dict[str, Any]  # {"name": "dead_zone:throttle", "c": 0.146}


def adopt_effects(
    workspace: Workspace, names: Sequence[str], *, parameters: bool = True
) -> tuple[tuple[Mapping[str, Any], ...], dict[str, float]]:
    """Adds diagnosed effects to [model] effects: all that are adopted now, and new parameters.

    Where the diagnosis calibrated the model's own parameters beside the effects, they are adopted
    too: the effects' values hold beside them.

    Raises:
        GroundedError: if nothing was diagnosed, or an effect is not in its ranking; nothing is
            written then.
    """
    document = _document(workspace)
    ranking = {str(entry["effect"]): entry for entry in document["ranking"]}
    adopted: list[Effect] = [dict(effect) for effect in workspace.config.model.effects]
    found = document.get("parameters", {}) if parameters else {}
    params = {key: _rounded(p["value"]) for key, p in found.items()}
    for name in dict.fromkeys(names):
        if name not in ranking:
            raise GroundedError(
                f"'{name}' is not among the effects of the last diagnosis: {nearest(name, ranking)}"
            )
        if any(effect["name"] == name for effect in adopted):
            raise GroundedError(
                f"'{name}' is adopted already; see [model] effects in grounded.toml"
            )
        values = _values(ranking[name])
        family, _, target = name.partition(":")
        if family == "parameter":
            nominal = workspace.base_model.params[target].value
            params[target] = _rounded(nominal + values["d"])
        else:
            adopted.append({"name": name, **values})
    whole = dict(workspace.config.model.params) | params
    set_in_model(workspace.config.file, params=whole if params else None, effects=adopted or None)
    return tuple(adopted), params


def _values(entry: Mapping[str, Any]) -> dict[str, float]:
    """An effect's quantities, those that were estimated and those that are fixed."""
    values = {key: _rounded(p["value"]) for key, p in entry["params"].items()}
    return values | {key: _rounded(value) for key, value in entry.get("fixed", {}).items()}


def _rounded(value: float) -> float:
    return float(f"{float(value):.8g}")


def _document(workspace: Workspace) -> dict[str, Any]:
    path = workspace.reports / FILE
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for entry in document["ranking"]:
            _ = str(entry["effect"]), entry["params"].items()
    except FileNotFoundError:
        raise GroundedError("nothing was diagnosed yet: run `grounded diagnose` first") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise GroundedError(
            f"{path} can't be read ({error}): run `grounded diagnose` again"
        ) from None
    return document
