"""grounded propose: show what to run next, what it will do, and whether to trust it."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import click

from grounded.result import begun, listed, measured_alike, with_error
from grounded.search.candidate import BY_STEP, LITTLE, UNLIKE, run_or_stop
from grounded.search.step.step_size import Step
from grounded.trial import mean_trial
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import LABEL, field, number, progress, remark, show, show_json
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import count, percent, with_unit

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from grounded.search.candidate import Candidate, Tried
    from grounded.search.standing import Standing
    from grounded.task import Task
    from grounded_trials import Workspace
    from grounded_trials.workspace.candidates.proposing import Proposed
    from grounded_trials.workspace.placing import FromStarts


MOST = 3  # target states whose range is shown at most
ENDS = 8  # final values are shown for models with at most this many states
RIGHT = 0.5  # of a promised gain, which a prediction missed by at most and noise costs at least
LAST = 3  # number of recent predictions whose errors are shown
MINOR = 0.1  # of the largest reason: a smaller one is not mentioned
LUCKY = 2.0  # standard errors within which a difference counts as scatter
MUCH = 0.2  # share of the best cost above which its part due to sensor noise is shown
MISSED = 0.5  # share of a run's cost: a model off by more cannot say what is left to gain
PLACED = 0.02  # share of a predicted utility: where runs began is told if it changes more
ASTRAY = 3.0  # a model that predicts more than this times a run's cost does not replay it


@click.command("propose")
@in_workspace
@as_json
def command(json_: bool) -> None:
    """Show what to run next and write its candidate file.

    The outstanding candidate is shown again while its trial is missing. Nothing is proposed once
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
    """Print what to run next.

    Args:
        workspace: the workspace.
        proposed: the result of `Workspace.propose`.
        last: whether to end with the next command.
    """
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
    if candidate.sample_age:
        show(field("samples", _samples(candidate, standing, workspace.task), "  "))
    if standing.incumbent is not None:
        from grounded_trials.workspace.identity import estimated_in

        guessed = estimated_in(workspace.trials())
        best, missed = standing.incumbent, proposed.noise_cost
        text, *parts = _so_far(candidate, best, workspace.task, guessed, missed).split("\n")
        show(field("so far", text, "  "))
        for part in parts:
            show(field("", part, "    "))
    replayed = proposed.noise_in_log - proposed.noise_cost
    trust = _trust(candidate, standing, workspace, proposed.noise_cost, replayed)
    trust += "; this model lacks what the last diagnosis found" * bool(proposed.lacks)
    if not standing.trials and not proposed.from_starts and not workspace.config.system.reachable:
        trust += (
            ". The prediction starts exactly at [task] start: what placing the robot less exactly "
            "costs is not in it, and shows after a few runs"
        )
    show(field("trust", trust, "  "))
    show_extent(candidate, workspace.task)
    if last:
        show(f"\n{next_line(proposed.then)}")


def _predicted(proposed: Proposed) -> str:
    """Return the predicted utility, and errors in units.

    If its log will have sensor noise that it lacks, the utility to be expected there is added, with
    all of the noise in it if that is much, as that of the best one is told.
    """
    assert proposed.candidate is not None
    promised, cost = proposed.candidate.predicted_utility, proposed.noise_cost
    text = f"utility {number(promised)}"
    in_log = promised - cost
    if cost > 0 and number(in_log) != number(promised):  # which `status` shows
        text += f", about {number(in_log)} in its log"
        replayed = proposed.noise_in_log - cost
        if share := _of_it(proposed.noise_in_log, in_log):
            text += share
            if replayed > MUCH * -promised:
                text += f" ({number(replayed)} is in {number(promised)} too: it replays a log)"
        else:
            text += ", including sensor noise"
    text += _from_usual_starts(proposed.from_starts, in_log)
    errors = "; ".join(one.summary() for one in proposed.off_target)
    return f"{text}; off target: {errors}" if errors else text


def _from_usual_starts(found: FromStarts | None, in_log: float) -> str:
    """Return what is predicted from where earlier runs began, if that matters; else ""."""
    if found is None or not max(abs(found.change), found.std) > PLACED * abs(in_log):
        return ""
    return (
        f"; {with_error(in_log + found.change, found.std)} from where the last {found.runs} runs "
        "began (+-: by their starts alone), instead of exactly at [task] start"
    )


def _samples(candidate: Candidate, standing: Standing, task: Task) -> str:
    """Return how old the samples are that the robot acts on."""
    from grounded.search.feedback.sample_age import different, run_ages

    ages = run_ages(task, standing.history)
    least, most = (float(f"{1e3 * f(ages, default=0):.2g}") for f in (min, max))
    span = f"{least:g} to {most:g} ms"
    old = with_unit(f"{float(f'{1e3 * abs(candidate.sample_age):.2g}'):g}", "ms")
    old += " old" if candidate.sample_age > 0 else " newer than in its log"
    if ages and different(task, min(ages), max(ages)):
        return f"{candidate.id} is planned for samples {old}; in the runs so far: {span}"
    return f"{candidate.base} acted on samples {old}; {candidate.id} is planned for that"


def _otherwise(candidate: Candidate, best: Tried) -> bool:
    """Return whether the model's utility of the base, the best one, clearly differs from its runs'.

    False for a candidate that is not based on the best one.
    """
    return candidate.base == best.candidate.id and candidate.unlike(best.utility)


def _so_far(
    candidate: Candidate,
    best: Tried,
    task: Task,
    estimated: Collection[str] = (),
    missed: float = 0.0,
) -> str:
    """Return the best one's utility and, if it differs clearly, what the model gives it and why.

    The gain of the candidate is counted from what the model gives the best one. Parts of the
    difference between the two follow, each on a line. The
    difference is split into three parts: the start (the model's own run starts at s_0, the real
    ones elsewhere, if by more than their sensors show), the noise in the runs' mean (which the
    model replays: it costs less than they do, because their scatter is averaged out), and the rest,
    which is the model's own error if it exceeds the scatter of the runs, if that is known.
    """
    from grounded.search.certainty import cost_of_start, planned_before
    from grounded_trials.workspace.off_target import began_elsewhere

    text = f"{number(best.utility)} by {best.candidate.id}{noise_share(best)}"
    if not _otherwise(candidate, best):
        less = candidate.less_in_log(best, missed)
        return f"{text}. {begun(less)}" if less else text
    same, told = candidate.expected_of_base, UNLIKE * abs(candidate.predicted_gain)
    own = f"{text}. For {best.candidate.id} itself the model predicts {number(same)}"
    if same < ASTRAY * best.utility:
        return f"{own}, so it does not reproduce those runs"
    gain, then = candidate.predicted_gain, ""
    if candidate.promised_over(best) == gain:
        more = f"{number(abs(gain))} {'better' if gain > 0 else 'worse'}"
        then = f". Compare {candidate.id} with that: it is {more}"
    better = "better" if same > best.utility else "worse"
    apart = f"{own}, {number(abs(same - best.utility))} {better} than measured"
    if not math.isfinite(candidate.base_as_run):
        return f"{apart}{then}"
    elsewhere = began_elsewhere(task, best.trials, best.candidate.predicted_states, estimated)
    start = cost_of_start(best, candidate) if elsewhere else 0.0
    start = start if math.isfinite(start) else 0.0
    each = [task.utility(trial) for trial in best.trials]
    mean = task.utility(mean_trial(best.trials, task.model.angle_mask)) - sum(each) / len(each)
    if planned_before(best, candidate):
        mean = 0.0
    off = listed(elsewhere.values())
    reasons = (
        (start, f"it begins at [task] start, the runs began off that, by {off}"),
        (mean, "it replays the mean of the runs, in which what differs between them cancels"),
    )
    parts = [(part, why) for part, why in reasons if abs(part) > told]
    rest = same - best.utility - sum(part for part, _ in parts)
    if math.isfinite(best.standard_error):
        within = abs(rest) <= LUCKY * best.standard_error
        parts.append(
            (rest, "within the scatter of the runs" if within else "the model's own error")
        )
    elif parts:
        parts.append((rest, "noise, or the model's own error (one run can't tell which)"))
    most = max((abs(part) for part, _ in parts), default=0.0)
    large = [(part, why) for part, why in parts if abs(part) > max(told, MINOR * most)]
    if len(large) == 1 and (large[0][0] > 0) == (same > best.utility):
        return f"{apart}: {large[0][1]}{then}"
    each_part = [f"\n{'+' * (part > 0)}{number(part)}: {why}" for part, why in large]
    are = "are" if len(large) == len(parts) else "are mostly"
    sum_of = f". The {number(same - best.utility)} between the two {are}" * bool(each_part)
    return f"{apart}{then}{sum_of}{''.join(each_part)}"


def noise_share(best: Tried) -> str:
    """Return how much of the best one's cost is sensor noise, if it is much; else ""."""
    return _of_it(best.noise_cost, best.utility)


def _of_it(noise: float, utility: float) -> str:
    """Return how much of a logged run's cost is due to sensor noise on average, if it is much."""
    if not noise > MUCH * -utility:
        return ""
    return f", {number(min(noise, -utility))} of it by sensor noise on average"


def _what(candidate: Candidate, standing: Standing, task: Task) -> str:
    """Describe how a candidate was made."""
    seconds = f"{task.horizon * task.dt:.4g} s"
    if candidate.way == "own plan":
        return f"the changed model's own plan, instead of a step from {candidate.base}, {seconds}"
    if candidate.way == "gentler gains":
        share = _gain(candidate) / next(
            _gain(t.candidate) for t in standing.history if t.candidate.id == candidate.base
        )
        return (
            f"{candidate.base} with its gains reduced to {percent(share)}: its feedback made the "
            f"inputs swing, {seconds}"
        )
    if candidate.base:
        step = Step(candidate.damping, candidate.alpha)
        by = ", with derivatives corrected by the trials" * candidate.of_corrected
        by += ", with derivatives corrected step by step" * (candidate.way == BY_STEP)
        by += ", its gains as low as ran without oscillating" * (candidate.caution > 0)
        if candidate.of_original:
            by += ", by the model without the adopted effects, whose steps kept too little"
            by += " of what they promised"
        return f"iteration {candidate.iteration}: {step} from {candidate.base}{by}, {seconds}"
    crashes = round(candidate.caution)  # crashes of earlier first policies
    gently = f", made gentler after {count(crashes, 'crash', 'crashes')}" * bool(crashes)
    return f"the model's own policy{gently}, {seconds}"


def _gain(candidate: Candidate) -> float:
    """Return the mean absolute feedback gain."""
    gain = candidate.policy.gain
    return 0.0 if gain is None else float(abs(gain).mean())


def show_extent(candidate: Candidate, task: Task) -> None:
    """Print where a candidate's predicted run goes."""
    rows = _extent(candidate, task)
    width = max(LABEL, *(len(name) for name, _ in rows))
    for name, text in rows:
        show(field(name, text, "  ", width))


def _extent(candidate: Candidate, task: Task) -> list[tuple[str, str]]:
    """Return (label, text) rows: ranges of the main states, ranges of inputs, the end."""
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
    """Return where the predicted run ends if the task has an aim at its end; else ""."""
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
    """Return the states whose range is shown: the position; else those in [safety] or a target."""
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
    """Format a range with two decimals, or up to six where all values are small."""
    size = max(abs(low), abs(high))
    if size < 0.5e-6:
        return "0"
    digits = 2 if not size < 1 else min(2 - math.floor(math.log10(size)), 6)
    return f"{round(low, digits) + 0.0:.{digits}f} to {round(high, digits) + 0.0:.{digits}f}"


def _trust(
    candidate: Candidate,
    standing: Standing,
    workspace: Workspace,
    missed: float = 0.0,
    replayed: float = 0.0,
) -> str:
    """Return how far recent predictions were off, and whether the promised gain exceeds that.

    If no run has tested the current model yet, return what it was compared with instead.

    Args:
        candidate: what to run next.
        standing: where the search stands.
        workspace: the workspace with the model.
        missed: cost of the sensor noise in its log that its prediction lacks.
        replayed: cost of the sensor noise that its prediction has, from the log that it replays.
    """
    ran = [tried for tried in standing.history if tried.utilities]
    same = [tried for tried in ran if tried.candidate.model == workspace.planner.fingerprint]
    if same:
        once = len(same) == 1
        alone = _by_itself(candidate, standing.incumbent, workspace) if once else math.nan
        return _came_true(candidate, same, standing, missed, replayed, alone)
    measured = _measured(workspace)
    if ran:
        since = "the model was changed since the last run"
        if not measured:
            return f"unknown: {since}, and no run has tested it since"
        return f"{since}: {measured}; no run has tested its plans yet"
    logs = len(workspace.trials()) - sum(len(tried.trials) for tried in standing.history)
    if measured:
        of_one = ", whose trials all made one motion" * _of_one_motion(workspace)
        return f"{measured}, by its diagnosis{of_one}; no run of this task has tested it yet"
    if not logs:
        return "unknown: the crude model was never compared with the real system"
    config = workspace.config.model
    parts = ["calibrated"] * bool(config.params) + ["given effects"] * bool(config.effects)
    done = " and ".join(parts)
    by = f"was {done} with" if done else "can be checked against"
    return (
        f"the model {by} {count(logs, 'log')} of data (`grounded diagnose` shows how well it "
        "predicts), but no run of this task has tested it yet"
    )


def _came_true(
    candidate: Candidate,
    same: Sequence[Tried],
    standing: Standing,
    lacks: float = 0.0,
    replayed: float = 0.0,
    alone: float = math.nan,
) -> str:
    """Return by how much the last predictions missed, and the gain that this one promises.

    The gain is one of predictions, which may lack some of the sensor noise in a log (`lacks`), and
    take the noise of a single log that they replay for what the robot does (`replayed`): with a
    model without a gap, a rover's first step lost in five of five searches. A prediction begins at
    [task] start; what it cost that runs began elsewhere is no error of it.

    Where the model foretold its one run so far, and by itself (`alone`) finds nothing to gain, the
    promise may be no more than the noise of that run: a boat's model was right to 1 % of its first
    run, promised 11 %, and four runs were spent on that.
    """
    from grounded.search.certainty import missed_by_start

    last = sorted(same, key=lambda tried: max(trial.id for trial in tried.trials))[-LAST:]
    began = [missed_by_start(one) for one in last]
    promises = [one.promised - cost for one, cost in zip(last, began, strict=True)]
    missed = [abs(promise - one.utility) for promise, one in zip(promises, last, strict=True)]
    whole = measured_alike([off for off in missed if math.isfinite(off)], "")
    failed = len(missed) - len(whole)
    if len(missed) == 1:
        promised, real = number(promises[-1]), number(last[-1].utility)
        said = number(last[-1].candidate.predicted_utility)
        noisy = number(last[-1].promised) != said
        counts = ["with sensor noise"] * noisy + ["from where its run began"] * bool(began[-1])
        also = f", or {promised} {listed(counts)}" * bool(counts)
        text = f"the last prediction was {said}{also}, the real run gave {real}"
        if failed:
            text = f"the last run failed, where {said} was predicted"
    elif not failed:
        noisy = any(one.promised != one.candidate.predicted_utility for one in last)
        counts = ["with sensor noise"] * noisy + ["from where runs began"] * any(began)
        counted = f", {listed(counts)}," * bool(counts)
        text = f"the last {len(whole)} predictions{counted} missed the utility by {listed(whole)}"
    elif not whole:
        text = f"the last {failed} runs failed"
    else:
        text = f"of the last {len(missed)} runs {failed} failed; for the others, predictions "
        text += f"missed the utility by {listed(whole)}"
    best, tried = standing.incumbent, {one.candidate.id for one in standing.history}
    if best is None or candidate.id in tried or not math.isfinite(missed[-1]):
        return text
    gain = candidate.promised_over(best)
    if candidate.way == "gentler gains":  # its run is that of the base, which lacked the swings
        return f"{text}; the model does not swing with any gains, so it can't say what these gain"
    if not gain > 0:
        return text
    said = number(candidate.predicted_utility)
    scale = " in the model" * (number(candidate.predicted_utility - lacks) != said)
    promise = f"{text}; this one promises a gain of {number(gain)}{scale}"
    then = ","
    if len(best.trials) == 1 and gain < replayed:
        then = ", and"
        promise += f", less than the sensor noise that it replays costs, {number(replayed)}"
    elif -math.inf < alone <= 0 and missed[-1] < RIGHT * gain < lacks + replayed:
        own = best.candidate.id
        return (
            f"{promise}, but may only replay the noise of one run: the model foretold that run, "
            f"and by itself puts {candidate.id} {number(-alone)} behind {own}. "
            f"{run_or_stop(gain, best)}"
        )
    if not gain < max(missed[-1], candidate.likely_off):
        return promise
    doubt = f"{promise}{then} less than such an error"
    if not gain < max(missed):
        doubt = f"{promise}{then} less than its likely error, {number(candidate.likely_off)}"
    blind = missed[-1] > MISSED * abs(last[-1].utility)
    little = gain < LITTLE * abs(best.utility) and not best.is_unsteady
    if blind or candidate.doubtful or not little:  # a note may say it
        return doubt
    return f"{doubt}. {run_or_stop(gain, best)}"


def _by_itself(candidate: Candidate, best: Tried | None, workspace: Workspace) -> float:
    """Return a step's gain in the model without the bias of the best one's only run; else NaN."""
    if best is None or len(best.trials) != 1 or candidate.base != best.candidate.id:
        return math.nan
    from grounded.rollout import simulate

    both = (best.candidate.policy, candidate.policy)
    planner = workspace.planner.feeding_back(both)
    problem = planner.plan.problem(exact=True)
    before, after = (simulate(problem, planner.widened(one)).utility for one in both)
    return float(after - before)


def _of_one_motion(workspace: Workspace) -> bool:
    """Return whether the last diagnosis had trials of one motion alone, so not of a new task's."""
    from grounded_trials.workspace.last_diagnosis import readable_diagnosis

    found = readable_diagnosis(workspace.reports)
    if found is None or found.made is None:
        return False
    return found.motions == 1 < len(found.made.trials)


def _measured(workspace: Workspace) -> str:
    """Return how well the current model predicts, by the last diagnosis; "" if there is none."""
    if not (workspace.reports / "diagnosis.json").is_file():
        return ""  # avoids the imports below
    from grounded_trials.report.settled import measured_now

    text = measured_now(workspace)
    return f"{text[:1].lower()}{text[1:]}".rstrip(".")
