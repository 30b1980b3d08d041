"""grounded fit: the model's parameters from all trials, with intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import names_in, number, progress, remark, show, show_json, table
from grounded_trials.wording import count, shown

if TYPE_CHECKING:
    from grounded.fit import Fit
    from grounded.model import Model


@click.command("fit")
@click.option("--params", metavar="A,B,...", help="Fit only these; the others keep their values.")
@click.option("--latency", is_flag=True, help="Fit one transport delay of all inputs too.")
@click.option("--apply", "apply_", is_flag=True, help="Write the values to grounded.toml.")
@in_workspace
@as_json
def command(
    params: str | None, latency: bool, apply_: bool, folder: str | None, json_: bool
) -> None:
    """Estimate parameters by maximum likelihood of the trials, noise included.

    Prediction errors are measured on a quarter of the time that the fit has not seen.
    """
    workspace = open_workspace(folder)
    from grounded.errors import GroundedError
    from grounded_trials.workspace.fitting import apply_fit, fit_trials

    names = names_in(params) or None
    if params is not None and names is None:
        raise GroundedError(
            "--params names no parameter: expected some, like a1,L; leave it out to fit all"
        )
    with progress("fitting"):
        found = fit_trials(workspace, names, latency=latency)
    if apply_:
        apply_fit(workspace, found)
    if json_:
        show_json(as_document(found, apply_))
        return
    show(_parameters(found))
    if found.before is not None and found.after is not None:
        show(f"\n{_errors(found, workspace.base_model)}")
    remark("fit", f"{found.sentence}; {count(found.samples, 'sample')}")
    if apply_:
        show("\nwritten to grounded.toml [model] params\nnext: grounded propose")
    else:
        again = f" --params {params}" * bool(params) + " --latency" * latency
        show("\n--apply writes the values to grounded.toml")
        show(f"next: grounded fit{again} --apply")


def as_document(found: Fit, applied: bool) -> dict[str, Any]:
    """The fields of CONTRACT.md, with intervals and held-out prediction errors."""
    document: dict[str, Any] = {
        "params": {
            name: {
                "value": e.value,
                "std": e.std,
                "low": e.low,
                "high": e.high,
                "unit": e.unit,
                "identified": e.identified,
                "start": e.start,
            }
            for name, e in found.params.items()
        },
        "status": found.status,
        "sentence": found.sentence,
        "samples": found.samples,
        "applied": applied,
    }
    for name, error in (("before", found.before), ("after", found.after)):
        if error is not None:
            document[f"prediction_error_{name}"] = {
                "horizon_s": error.horizon_s,
                "one_step": dict(zip(error.names, error.one_step.tolist(), strict=True)),
                "ahead": dict(zip(error.names, error.ahead.tolist(), strict=True)),
            }
    return document


def _parameters(found: Fit) -> str:
    rows = []
    for name, e in found.params.items():
        interval = f"{number(e.low)} .. {number(e.high)}" if e.identified else "not identified"
        rows.append((name, number(e.start), number(e.value), interval, shown(e.unit)))
    return table(rows, ("parameter", "before", "fitted", "95 % interval", "unit"))


def _errors(found: Fit, model: Model) -> str:
    assert found.before is not None and found.after is not None
    rows = []
    for i, name in enumerate(found.before.names):
        rows.append(
            (
                name,
                number(float(found.before.one_step[i]), 3),
                number(float(found.after.one_step[i]), 3),
                number(float(found.before.ahead[i]), 3),
                number(float(found.after.ahead[i]), 3),
                shown(model.states.get(name, "")),
            )
        )
    ahead = f"{found.before.horizon_s:g} s"
    header = ("held-out error", "1 step before", "after", f"{ahead} before", "after", "unit")
    return table(rows, header)
