"""A decision, written out as a `Diagnosis`: what each room of the diagnosis says of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.diagnosis.causes import meaning, value_called
from grounded.diagnosis.error_report import (
    ChannelShare,
    Credit,
    Gap,
    Remainder,
    RulerRow,
    Where,
    excess,
    furthest,
    objection,
    open_noise,
)
from grounded.diagnosis.hypotheses.leftover import correction
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import (
    Changed,
    Diagnosis,
    NoiseLevels,
    Ranked,
    Score,
    TrialGroup,
    Unconfirmed,
    Verdict,
)
from grounded.diagnosis.remarks import next_step, remarks
from grounded.diagnosis.validation.agreement import by_trial
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Decision, Doubtful
from grounded.diagnosis.validation.limits import Sound
from grounded.diagnosis.validation.measured import (
    Measured,
    by_region,
    by_time,
    explained,
)
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import acting_order, wrapping_order
from grounded.findings import Finding, found
from grounded.places import position
from grounded.result import number
from grounded.task import Task

MOST_EFFECTS = 12  # most effects blamed at once
NAMED = 2  # most parameters in the words of a cause
MENTIONED = 2  # most effects that one group of trials shows


class Writer:
    """Turns a decision into a Diagnosis."""

    def __init__(
        self,
        decision: Decision,
        ruler: Ruler,
        sound: Sound,
        adopted: Collection[str],
        most: int,
        tick: Callable[[str], None],
        task: Task | None,
        uncertain: Predictor,
    ) -> None:
        self.decision, self.ruler, self.known, self.task = decision, ruler, sound.limits, task
        self.adopted, self.most, self.tick = adopted, most, tick
        self.preflight = sound.looked.findings
        self.trials = [trial for trial in sound.looked.trials if trial.known_steps >= 2]
        self.search, self.best = decision.search, decision.fit
        self.predictor, self.data = self.search.predictor, self.search.data
        self.shown = list(zip(ruler.shown, ruler.names, strict=True))
        self.measured = Measured(decision, ruler, self.trials, sound.first, sound.exact)
        credit = {one.of: one.share for one in self.measured.credits}
        self.claims = Claims(decision, credit, self.known, ruler, uncertain)
        self.left = self.measured.left

    def diagnosis(self, apart: tuple[Changed, ...] | None = None) -> Diagnosis:
        """All of it; `apart` is what differs between two groups of trials, if there are two."""
        data, predictor = self.data, self.predictor
        self.tick("gap")
        gain = explained(predictor, Hypothesis(), self.best)
        if self.left:
            i = data.model.state_names.index(self.left[0].channel)
            gain = gain.copy()
            gain[..., i] += self.left[0].improvement
        ranking = self.claims.ranking(self.measured)
        groups = self.claims.groups()
        same = self.claims.equivalent(groups)
        measured = self.measured
        remainder = measured.remainders()
        rows, credit = measured.prediction_error(), measured.credits
        named = [row.effect for row in ranking if row.claimed]
        located = bool(named or remainder)  # else the gap is noise: shares of it tell nothing
        if remainder and not named:  # what is left elsewhere is no gap
            off_too = [data.model.state_names.index(one.channel) for one in remainder]
            gain = np.where(np.isin(np.arange(gain.shape[-1]), off_too), gain, 0.0)
        channels = self.channels(gain if located else np.full_like(gain, np.nan), rows)
        seen = unconfirmed(self.claims, self.decision.doubtful, groups)
        values, agreement = by_trial(self.best, data, named) if named else ((), ())
        moved, parameters = len(data.groups), self.claims.parameters()
        identified = self.claims.identified
        said = self.verdict(ranking, remainder, rows, credit)
        found = Diagnosis(
            verdict=said,
            where=Where(
                channels=channels,
                times=tuple(by_time(gain.sum(axis=-1), data)) if located else (),
                regions=tuple(by_region(gain.sum(axis=-1), predictor, self.best))
                if located
                else (),
                whiteness=measured.whiteness,
                tempering=self.search.tempering.factor,
            ),
            ranking=ranking,
            acting=_in_action(self.best.hypothesis, said.effects),
            indistinguishable=groups,
            equivalent=same,
            gap=Gap(
                horizon_s=self.ruler.steps[-1] * data.dt,
                unit="noise-normalised rms",
                before=measured.gap(self.decision.crude),
                after=measured.gap(self.best),
                floor=1.0,
                held_out=self.ruler.held_out,
            ),
            leftover=remainder,
            unconfirmed=seen,
            correction=correction(self.ruler, self.best, self.left),
            noise=self.noise(),
            parameters=parameters,
            identifiable=identified.parameters,
            combinations=identified.combinations,
            prediction_error=rows,
            credit=credit,
            per_trial=values,
            agreement=agreement,
            changed=apart,
            trials=data.count,
            motions=moved,
            groups=tuple(
                TrialGroup(
                    f"g{k}",
                    tuple(data.ids[i] or f"#{i + 1}" for i in group.trials),
                    group.differs_in,
                )
                for k, group in enumerate(data.groups, 1)
            ),
            held_out=self.ruler.by,
            score=self.score(),
            steps=data.steps,
            candidates=len(self.search.candidates),
            preflight=self.preflight,
            tracked=() if self.task is None else _tracked(self.task),
        )
        return replace(found, findings=self.findings(found))

    def findings(self, d: Diagnosis) -> tuple[Finding, ...]:
        """What is told beside the diagnosis' lines, and the next step."""
        known, rows = self.known.findings, d.prediction_error
        off = d.leftover[0].channel if d.leftover else open_noise(rows)
        ties = [group for group in d.indistinguishable if group not in d.equivalent]
        doubt = objection(rows, d.agreement, d.effects, ties, d.leftover)
        step = next_step(d, self.claims, doubt, off, self.trials, self.adopted)
        more = [found("gap.more", most=self.most)] * d.verdict.again
        return (*known, *more, *remarks(d, self.data.model, self.adopted), step)

    def verdict(
        self,
        ranking: Sequence[Ranked],
        remainder: Sequence[Remainder],
        rows: Sequence[RulerRow],
        credit: Sequence[Credit],
    ) -> Verdict:
        """The kind of the verdict, and the causes in words."""
        claims, row = self.claims, furthest(rows)
        if claims.known.no_cause:
            return Verdict("unknown", limit=claims.known.findings[0].code)
        claimed = tuple(row.effect for row in ranking if row.claimed)
        if not claimed:
            bound = row is not None and row.floor_at_most
            unsure = bound and not excess(rows) and not self.adopted
            return Verdict("unknown" if remainder or unsure else "none")
        off = tuple(self.data.model.param_names[one.index] for one in claims.moved)
        return Verdict(
            "effect" if len(claimed) == 1 else "several",
            effects=claimed,
            causes=self.causes(ranking, credit, off),
            parameters=off,
            again=len(claims.names) == self.most and any(one.above for one in remainder),
        )

    def causes(
        self, ranking: Sequence[Ranked], credit: Sequence[Credit], off: Sequence[str]
    ) -> tuple[str, ...]:
        """The words of each cause, the largest first."""
        params, known = self.data.model.params, self.claims.parameters()
        values = {row.effect: row.params for row in ranking}
        effects = {effect.name: effect for effect in self.best.hypothesis.effects}
        called = [value_called(name, self.adopted) for name in off]
        each = (
            f"{c} = {known[n].text}, was {number(params[n].value)}"
            for c, n in zip(called, off, strict=True)
        )
        more = [f"{len(off) - NAMED} more"] * (len(off) > NAMED)
        shown = tuple(each) if len(off) <= NAMED else None
        own = found("model.off", values=shown, names=(*called[:NAMED], *more)).sentence
        return tuple(
            meaning(effects[one.of], values[one.of]) if one.of in effects else own for one in credit
        )

    def score(self) -> Score:
        """Log scores of the crude model, the choice and the reference."""
        ruler, choice = self.ruler, self.decision.choice
        crude = ruler.score(self.decision.crude)
        chosen = crude + ruler.gain(self.decision.crude, self.best).mean
        return Score(crude, chosen, chosen + choice.lost, choice.standard_error)

    def channels(self, gain: Any, rows: Sequence[RulerRow]) -> tuple[ChannelShare, ...]:
        """Each state's part of the gap, NaN of NaN, with the ruler's errors a second ahead."""
        excess = np.maximum(gain.sum(axis=(0, 1)), 0.0)
        share = excess / max(float(excess.sum()), 1e-12)
        ahead = furthest(rows) or rows[0]
        found = [
            ChannelShare(
                name,
                share=float(share[i]),
                rms=ahead.crude[name],
                unit=self.data.model.states[name],
                noise=ahead.noise_floor[name],
            )
            for i, name in self.shown
        ]
        return tuple(sorted(found, key=lambda one: -np.nan_to_num(one.share)))

    def noise(self) -> NoiseLevels:
        """The noise as it was estimated."""
        noise = self.best.noise
        tau = noise.structure.tau
        q, r = np.exp(0.5 * noise.log_q), np.exp(0.5 * noise.log_r)
        return NoiseLevels(
            process={name: float(q[i]) for i, name in self.shown},
            measurement={name: float(r[i]) for i, name in self.shown},
            correlation_s=np.nan if tau is None else tau,
            outliers=not isinstance(noise.weight_v, float),
        )


def _tracked(task: Task) -> tuple[str, ...]:
    """Return the states that the reward weighs: those of the position, then others, rates last."""
    weighed = task.reward.state + task.reward.terminal
    followed = (weighed != 0) & np.isfinite(task.target).any(axis=0)
    names = [n for n, own in zip(task.model.state_names, followed, strict=True) if own]
    first = position(task.model)
    rates = {n for n in names if task.model.states[n].endswith("/s")}
    return tuple(sorted(names, key=lambda n: (n not in first, n in rates)))


def _in_action(h: Hypothesis, claimed: Sequence[str]) -> tuple[str, ...]:
    """Claimed effects in the order in which they act; parameters last."""
    families = [effect.family for effect in h.effects]
    order, whole = acting_order(families), wrapping_order(families)
    names = [h.names[i] for i in (*order, *(i for i in whole if i not in order))]
    return tuple(n for n in dict.fromkeys((*names, *claimed)) if n in claimed)


def unconfirmed(
    claims: Claims,
    doubtful: Sequence[Doubtful],
    groups: Sequence[Sequence[str]] = (),
) -> tuple[Unconfirmed, ...]:
    """Return the likeliest effects that only one group of trials shows, without ties.

    Args:
        claims: the causes that are claimed.
        doubtful: the likely effects that were dropped.
        groups: effects that the data cannot tell apart.
    """
    tied = {name for group in groups for name in group}
    found = [
        Unconfirmed(
            one.name,
            claims.estimates(one.fit)[one.fit.hypothesis.names.index(one.name)],
            one.nats,
            tuple(claims.data.ids[k] or str(k + 1) for k in one.trials),
        )
        for one in doubtful
        if one.name not in tied and not claims.known.no_cause
    ]
    return tuple(found[:MENTIONED])
