"""grounded propose: what to run next, what it will do, and whether to trust it."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import click

from grounded.result import listed
from grounded.search.candidate import LITTLE, UNLIKE
from grounded.search.step_size import Step
from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.terminal import LABEL, field, number, progress, remark, show, show_json
from grounded_trials.wording import count, percent, with_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded.search.candidate import Candidate, Tried
    from grounded.search.standing import Standing
    from grounded.task import Task
    from grounded_trials import Workspace
    from grounded_trials.workspace.proposing import Proposed


MOST = 3  # target states whose range is told
ENDS = 8  # states whose values at the end are told: a table of more says nothing
LAST = 3  # predictions whose misses are told
LUCKY = 2.0  # standard errors
NOISY = 0.1  # of a promised cost: how much of noise in its log is told
MUCH = 0.2  # of what the best one costs: sensors' noise that is told
MISSED = 0.5  # of a run's cost: a model off by more doesn't know what is left to gain
ASTRAY = 3.0  # times what a run cost: a model that gives it so much does not replay it


@click.command("propose")
@in_workspace
@as_json
def command(json_: bool) -> None:
    """Say what to run next and write its candidate file.

    The outstanding candidate is named again while its trial is missing. Nothing is proposed once
    the search has ended.
    """
    workspace = open_workspace()
    with progress("planning"):
        proposed = workspace.propose()
    if json_:
        show_json(proposed.to_json())
    else:
        tell_proposed(workspace, proposed)


def tell_proposed(workspace: Workspace, proposed: Proposed, *, last: bool = True) -> None:
    """Says what to run next; `last`: and the command after that."""
    standing, candidate = proposed.standing, proposed.candidate
    for note in proposed.proposal.notes:
        remark("note", note)
    if note := workspace.planner.plan.model.system.note:
        remark("note", f"the model is {note}")
    if candidate is None:
        show(field("end", f"nothing to run: {standing.sentence}"))
        show(f"\n{next_line(proposed.then)}")
        return
    ran = any(t.candidate.id == candidate.id and t.trials for t in standing.history)
    waiting = "" if proposed.proposal.is_new else " (proposed before, its trial is missing)"
    show(f"Run {candidate.id}{' once more' if ran else waiting}: {proposed.file}")
    if ran:
        show(field("why", standing.sentence, "  "))
    show(field("what", _what(candidate, standing, workspace.task), "  "))
    show(field("predicted", _predicted(proposed), "  "))
    if standing.incumbent is not None:
        show(field("so far", _so_far(candidate, standing.incumbent, workspace.task), "  "))
    show(field("trust", _trust(candidate, standing, workspace), "  "))
    show_extent(candidate, workspace.task)
    if last:
        show(f"\n{next_line(proposed.then)}")


def _predicted(proposed: Proposed) -> str:
    """The promise, and what a log of it is likely to show where sensors' noise costs much."""
    assert proposed.candidate is not None
    promised, cost = proposed.candidate.predicted_utility, proposed.noise_cost
    text = f"utility {number(promised)}"
    if not cost > NOISY * abs(promised):
        return text
    return f"{text}; about {number(promised - cost)} in its log, where sensors' noise counts, too"


def _otherwise(candidate: Candidate, best: Tried) -> bool:
    """Whether the model gives the best one, on which this one is based, clearly something else."""
    return candidate.base == best.candidate.id and candidate.unlike(best.utility)


def _so_far(candidate: Candidate, best: Tried, task: Task) -> str:
    """The best one's utility; beside it what the model gives it, and why, as far as that is known.

    The model's own run of it starts at s_0: what that is worth is known where its runs began
    elsewhere by more than their sensors' noise, and so is the scatter of its runs once something
    near it was repeated. What is left, the model does not replay. What is told adds up.
    """
    from grounded_trials.workspace.off_target import began_elsewhere

    text = f"{number(best.utility)} by {best.candidate.id}{noise_share(best)}"
    if not _otherwise(candidate, best):
        return text
    same, told = candidate.expected_of_base, UNLIKE * abs(candidate.predicted_gain)
    if same < ASTRAY * best.utility:
        return f"{text}, which the same model does not replay: it gives {number(same)}"
    text = f"{text}, to which the same model gives {number(same)}"
    if not math.isfinite(candidate.base_as_run):
        return text
    elsewhere, why = began_elsewhere(task, best.trials), []
    start = same - candidate.base_as_run if elsewhere else 0.0
    if abs(start) > told:
        where = f"elsewhere than [task] start in {listed(elsewhere)}"
        why.append(f"{_dearer(start)} because its runs began {where}")
    else:
        start = 0.0
    rest, known = same - start - best.utility, math.isfinite(best.standard_error)
    if abs(rest) > told and (known or why):
        within = abs(rest) <= LUCKY * best.standard_error
        lucky = "within the scatter of its runs" if within else "more than its runs scatter"
        unknown = "and how far its runs scatter is not known"
        why.append(f"{_dearer(rest)} that it does not explain, {lucky if known else unknown}")
    return f"{text}: the model's run costs {', and '.join(why)}" if why else text


def noise_share(best: Tried) -> str:
    """How much of what the best one costs no policy takes away, where it is much; else ""."""
    if not best.noise_cost > MUCH * -best.utility:
        return ""
    return f", about {number(min(best.noise_cost, -best.utility))} of it noise of the sensors"


def _dearer(gain: float) -> str:
    return f"{number(abs(gain))} {'less' if gain > 0 else 'more'}"


def _what(candidate: Candidate, standing: Standing, task: Task) -> str:
    """Where a candidate comes from."""
    seconds = f"{task.horizon * task.dt:g} s"
    if candidate.way == "own plan":
        return f"the changed model's own plan, in place of a step from {candidate.base}, {seconds}"
    if candidate.way == "gentler gains":
        share = _gain(candidate) / next(
            _gain(t.candidate) for t in standing.history if t.candidate.id == candidate.base
        )
        return (
            f"{candidate.base} with gains of {percent(share)}: its feedback swung the inputs to "
            f"and fro, {seconds}"
        )
    if candidate.base:
        step = Step(candidate.damping, candidate.alpha)
        by = ", by slopes that the trials corrected" * bool(candidate.slopes)
        return f"iteration {candidate.iteration}: {step} from {candidate.base}{by}, {seconds}"
    crashes = round(candidate.caution)  # of a first policy
    gently = f", designed more gently after {count(crashes, 'crash', 'crashes')}" * bool(crashes)
    return f"the model's own policy{gently}, {seconds}"


def _gain(candidate: Candidate) -> float:
    """The mean size of the feedback's gains."""
    gain = candidate.policy.gain
    return 0.0 if gain is None else float(abs(gain).mean())


def show_extent(candidate: Candidate, task: Task) -> None:
    """Shows where a candidate's predicted run goes."""
    rows = _extent(candidate, task)
    width = max(LABEL, *(len(name) for name, _ in rows))
    for name, text in rows:
        show(field(name, text, "  ", width))


def _extent(candidate: Candidate, task: Task) -> list[tuple[str, str]]:
    """Where the predicted run goes, and how much of the inputs it uses."""
    model, rows = task.model, []
    for name in _told(task):
        values = candidate.predicted_states[:, model.state_names.index(name)]
        rows.append((name, with_unit(_span(values.min(), values.max()), model.states[name])))
    for i, (name, unit) in enumerate(model.inputs.items()):
        low, high = float(task.low[i]), float(task.high[i])
        ends = re.sub(r"\.?0+(?= |$)", "", _span(low, high))
        limits = f", limits {ends}" * (high < float("inf"))
        values = candidate.predicted_inputs[:, i]
        rows.append((name, with_unit(_span(values.min(), values.max()), unit) + limits))
    if text := _end(candidate, task):
        rows.append(("at the end", text))
    return rows


def _end(candidate: Candidate, task: Task) -> str:
    """Where the predicted run ends, of a task that is to get somewhere; "" of others."""
    from grounded_trials.workspace.off_target import reaches

    model, last, aim = task.model, candidate.predicted_states[-1], task.target[-1]
    if not (task.reward.terminal.any() or reaches(task)) or model.n > ENDS:
        return ""
    told = []
    for name, value, wanted in zip(model.state_names, last, aim, strict=True):
        to = f" (target {number(wanted)})" * math.isfinite(wanted)
        told.append(f"{with_unit(f'{name} {number(value)}', model.states[name])}{to}")
    return ", ".join(told)


def _told(task: Task) -> list[str]:
    """The states that say where a run goes: the position; else those of [safety] and a target."""
    model, position = task.model, task.model.roles.get("position", ())
    where = [position] if isinstance(position, str) else list(position)
    if found := [name for name in where if name in model.states]:
        return found
    assert task.safety_low is not None and task.safety_high is not None
    ends = zip(model.state_names, task.safety_low, task.safety_high, strict=True)
    guarded = [name for name, low, high in ends if math.isfinite(low) or math.isfinite(high)]
    tracked = zip(model.state_names, (task.target == task.target).any(axis=0), strict=True)
    wanted = [name for name, told in tracked if told and name not in guarded][:MOST]
    return [name for name in model.state_names if name in guarded or name in wanted]


def _span(low: float, high: float) -> str:
    """From the lowest to the highest value, to a hundredth, or a millionth where all are small."""
    size = max(abs(low), abs(high))
    if size < 0.5e-6:
        return "0"
    digits = 2 if not size < 1 else min(2 - math.floor(math.log10(size)), 6)
    return f"{round(low, digits) + 0.0:.{digits}f} to {round(high, digits) + 0.0:.{digits}f}"


def _trust(candidate: Candidate, standing: Standing, workspace: Workspace) -> str:
    """How predictions came true, and whether this one's gain is more than they missed by.

    Before a run has tested the model that plans now: what it was compared with.
    """
    ran = [tried for tried in standing.history if tried.utilities]
    same = [tried for tried in ran if tried.candidate.model == workspace.planner.fingerprint]
    if same:
        return _came_true(candidate, same, standing)
    measured = _measured(workspace)
    if ran:
        since = "the model was changed since the last run"
        if not measured:
            return f"unknown: {since}, none has tested it as it is now"
        return f"{since}: {measured}; no run has tested its plans yet"
    logs = len(workspace.trials()) - sum(len(tried.trials) for tried in standing.history)
    if measured:
        return f"{measured}, by its diagnosis; it was never tried on this manoeuvre"
    if not logs:
        return "unknown: the crude model was never compared with the real system"
    config = workspace.config.model
    done = " and ".join(["fitted"] * bool(config.params) + ["given effects"] * bool(config.effects))
    by = f"was {done} with" if done else "can be judged by"
    return (
        f"the model {by} {count(logs, 'log')} of data (`grounded diagnose` says how far it "
        "predicts), but it was never tried on this manoeuvre"
    )


def _came_true(candidate: Candidate, same: Sequence[Tried], standing: Standing) -> str:
    """By how much the last predictions missed, beside the gain that this one promises."""
    last = sorted(same, key=lambda tried: max(trial.id for trial in tried.trials))[-LAST:]
    promises = [one.promised for one in last]
    missed = [abs(promise - one.utility) for promise, one in zip(promises, last, strict=True)]
    whole = [number(off) for off in missed if math.isfinite(off)]
    failed = len(missed) - len(whole)
    if len(missed) == 1:
        promised, real = number(promises[-1]), number(last[-1].utility)
        said = number(last[-1].candidate.predicted_utility)
        noise = f" ({said} without its sensors' noise)" * (said != promised)
        text = f"the last prediction was {promised}{noise}, the real run gave {real}"
        if failed:
            text = f"the last run failed, where {promised}{noise} was predicted"
    elif not failed:
        text = f"the last {len(whole)} predictions missed by {listed(whole)}"
    elif not whole:
        text = f"the last {failed} runs failed"
    else:
        text = f"of the last {len(missed)} runs {failed} failed; where they did not, predictions "
        text += f"missed by {listed(whole)}"
    best, tried = standing.incumbent, {one.candidate.id for one in standing.history}
    if best is None or candidate.id in tried or not math.isfinite(missed[-1]):
        return text
    gain = candidate.promised_over(best)
    if not gain > 0:
        return text
    promise = f"{text}; this one promises a gain of {number(gain)}"
    if not gain < max(missed[-1], candidate.likely_off):
        return promise
    doubt = f"{promise}, which is no more than such a miss"
    blind = missed[-1] > MISSED * abs(last[-1].utility)
    if blind or candidate.doubtful or not gain < LITTLE * abs(best.utility):  # a note may say so
        return doubt
    return f"{doubt}: you may stop here, with {best.candidate.id}, the best so far"


def _measured(workspace: Workspace) -> str:
    """How far the model that plans now predicts, by the last diagnosis; "" where none says it."""
    if not (workspace.reports / "diagnosis.json").is_file():
        return ""  # and nothing that reads one is imported
    from grounded_trials.report.settled import measured_now

    text = measured_now(workspace)
    return f"{text[:1].lower()}{text[1:]}".rstrip(".")
