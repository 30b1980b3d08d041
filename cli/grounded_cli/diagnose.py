"""grounded diagnose: where the model is wrong, which effect makes it so, how far it shrinks."""

from __future__ import annotations

from typing import Any

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, library_of, open_workspace
from grounded_cli.terminal import field, number, show, show_json, stages, table


@click.command("diagnose")
@click.option(
    "--trials",
    metavar="T1,T2,...",
    shell_complete=complete.trials,
    help="Only these trials (default: all).",
)
@click.option("--max-effects", type=click.IntRange(1, 6), default=3, help="At most K at once.")
@click.option("--without", multiple=True, metavar="FAMILY", help="A family not to blame.")
@in_workspace
@as_json
def command(
    trials: str | None, max_effects: int, without: tuple[str, ...], folder: str | None, json_: bool
) -> None:
    """Explain the sim-to-real gap from the stored trials; keeps reports/diagnosis.json.

    The verdict is one effect, several, none (the model explains the data down to the noise) or
    unknown (a gap that no known effect explains). Where two effects tie, a probe candidate that
    would tell them apart is written.
    """
    workspace = open_workspace(folder)
    from grounded_trials.diagnosing import diagnose_in

    chosen = [name.strip() for name in trials.split(",")] if trials else []
    library = library_of(without)
    with stages() as tell:
        found = diagnose_in(
            workspace, trials=chosen, max_effects=max_effects, library=library, progress=tell
        )
    if json_:
        show_json(found.document)
    else:
        _tell(found.document)


def _tell(document: dict[str, Any]) -> None:
    verdict, gap = document["verdict"], document["gap"]
    show(field("verdict", f"{verdict['kind']}: {verdict['sentence']}"))
    for text in document.get("unknowable", []):
        show(field("unknown", text))
    show(field("gap", _gap(gap)))
    channels = [
        (c["name"], f"{100 * c['share']:.0f} %", f"{number(c['rms'], 3)} {c['unit']}")
        for c in document["where"]["channels"]
        if c["share"] >= 0.005
    ]
    if channels:
        show("\n" + table(channels, ("where", "share of the gap", "rms")))
    for region in document["where"]["regions"][:3]:
        share, time = 100 * region["share"], 100 * region["occupancy"]
        show(field("", f"{region['when']}: {share:.0f} % of the gap in {time:.0f} % of the time"))
    ranking = document["ranking"][:8]
    if ranking:
        rows = [_ranked(entry) for entry in ranking]
        show("\n" + table(rows, ("effect (*: claimed)", "evidence [nats]", "gap after")))
    for entry in ranking:
        if entry.get("claimed"):
            show(field(entry["effect"], _values(entry)))
    for group in document["indistinguishable"]:
        show(field("alike", f"the data can't tell apart: {', '.join(group)}"))
    show("\n" + field("next trial", document["next_trial"]))
    effects = verdict["effects"]
    follow = f"grounded adopt {effects[0]}" if effects else "grounded report --html"
    show(f"\nnext: {follow}")


def _gap(gap: dict[str, Any]) -> str:
    held = "held out" if gap["held_out"] else "not held out, too few trials"
    return (
        f"{number(gap['before'], 3)} before, {number(gap['after'], 3)} after, noise floor "
        f"{number(gap['floor'], 3)} ({gap['unit']}, {gap['horizon_s']:g} s ahead, {held})"
    )


def _ranked(entry: dict[str, Any]) -> tuple[str, str, str]:
    mark = "* " if entry.get("claimed") else "  "
    return mark + entry["effect"], f"{entry['evidence']:.1f}", number(entry["gap_after"], 3)


def _values(entry: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} = {number(p['value'], 3)} +- {number(p['std'], 2)} {p['unit']}"
        for name, p in entry["params"].items()
    )
