"""START HERE: all that sensors and commands show before any physics is identified, in one call.

signals      samples of one sensor: missing, stuck, held, wrapped; copies and limits of commands
judge        which account of the table tells how each log came about
ages         late, filtered and computed velocities, biases
commands     clocks that differ, inputs that act in reverse
time_step    a model, or a motion, that is too fast for the steps

What is certain is corrected in the trials passed on; what can't be is refused, with the remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from grounded.accounts.ages import Ages
from grounded.accounts.commands import judge_clocks, judge_signs
from grounded.accounts.finding import Finding, Preflight, UnusableTrials
from grounded.accounts.judge import Verdict, judge
from grounded.accounts.levels import GROSS, HALF
from grounded.accounts.reported import keys, names_of, reported
from grounded.accounts.signals import judge_samples
from grounded.accounts.table import Told
from grounded.accounts.time_step import judge_resolution, judge_time_step
from grounded.findings import Quantity
from grounded.findings import found as told_
from grounded.model import Model
from grounded.result import per_second
from grounded.task import Task
from grounded.trial import Trial


def sound_trials(
    subject: Task | Model,
    trials: Sequence[Trial],
    hidden: Sequence[str] = (),
    first: int | None = None,
    one_message: Sequence[str] = (),
) -> Preflight:
    """Run all checks of sensors and commands, and correct the trials where that is certain.

    Args:
        subject: the model, whose kinematics relate the sensors; a task adds the input limits.
        trials: real ones, of one time grid; unchanged if they don't fit the model.
        hidden: states without a sensor.
        first: number of trials in the first of two groups, between which inputs may change their
            signs; None: one group.
        one_message: states that are logged in one message, so that all or none of them are late.

    Returns:
        The findings and the corrected trials.

    Raises:
        UnusableTrials: for logs that can't be used, with the correction.
    """
    model = subject.model if isinstance(subject, Task) else subject
    names = (model.state_names, model.input_names)
    used = [t.until(t.known_steps) for t in trials if t.known_steps >= 2]
    if not used or any((t.state_names, t.input_names) != names for t in used):
        return Preflight((), tuple(trials))
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    with np.errstate(all="ignore"):
        # samples first, since a drop-out looks like motion
        found, used = judge_samples(model, used, shown)
        verdict = judge(model, used, shown)
        refuse(model, used, verdict)
        found += [one for told in verdict.told for one in corrections(model, used, told)]
        used = list(verdict.corrected)
        for k, keep, cut in list(judge_resolution(model, used, shown)):
            if keep >= 2:
                used[k] = used[k].until(keep)
                found.append(cut)
        # what is late, on trials in their units
        ages = Ages(model, used, shown)
        found += ages.findings(one_message)
        found += _unexplained(model, verdict)
        found += judge_time_step(model, ages.trials, ages.shown)
    judge_clocks(model, ages.trials, shown)
    for group in (ages.trials[:first], ages.trials[first:] if first else ()):
        judge_signs(model, group, shown)
    return Preflight(
        tuple(found), tuple(ages.trials), frozenset(ages.in_step), frozenset(ages.refuted)
    )


def refuse(model: Model, trials: Sequence[Trial], verdict: Verdict) -> None:
    """Raise an error for the first account that can't be corrected here.

    Raises:
        UnusableTrials: with the trials, the account, its evidence and the remedy.
    """
    stops = [one for one in verdict.told if not (one.certain or one.account.kind == "offset")]
    if stops:
        odd = stops[0].trials
        some = [one for stop in stops if stop.trials == odd for one in reported(model, stop)]
        raise UnusableTrials(trials, odd, *some)


def corrections(model: Model, trials: Sequence[Trial], told: Told) -> Iterator[Finding]:
    """Yield the findings of an account that is corrected, or only reported: an offset."""
    account = told.account
    which = (
        () if told.whole else tuple(trials[k].id or f"trial number {k + 1}" for k in told.trials)
    )
    for k in account.columns if told.certain or account.kind == "offset" else ():
        (name,), said = names_of(model, [k]), reported(model, told, k)[0].also(which=which)
        if account.kind == "dead":
            yield Finding(name, said, "stuck", corrected=True)
        elif account.kind == "offset":
            yield Finding(name, said, "offset")
        else:
            kind = "degrees" if account.kind == "unit" else "sign"
            kind = "scale" if kind == "degrees" and k >= model.n and account.unit != "deg" else kind
            mended = {} if which else keys(model, account, k)
            yield Finding(name, said, kind, scale=account.factor, corrected=True, keys=mended)


def _unexplained(model: Model, verdict: Verdict) -> Iterator[Finding]:
    """Yield a finding for each row of several sensors that the trials contradict grossly."""
    for row, gap in verdict.open.items():
        if len(row.by) < 2 or gap.share < GROSS or gap.varying < HALF:
            continue  # at rest in a current
        name, *by = (model.state_names[i] for i in (row.i, *row.by))
        off = Quantity(float(gap.rate), per_second(model.states[name]))
        said = told_("sensor.mismatch", name, of=tuple(by), off=off)
        yield Finding(name, said, "mismatch")
