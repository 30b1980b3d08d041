"""What no effect explains, as a curve that may be adopted: it must predict new trials better."""

import json

import numpy as np
import pytest

from grounded import GroundedError
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Correction, Curve
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.effects import Library, wrap
from grounded_trials import Workspace
from grounded_trials.store.documents import write_document
from small_tasks import pushed_cart

FEW = ("offset", "delay", "slope")  # families, so that none has a threshold


def one_second(model, trials):
    """Rms error of v a second ahead."""
    errors = []
    for trial in trials:
        x, u = trial.states[:-20], trial.inputs
        for k in range(20):
            x = model.system.step(x, u[k : len(u) - 19 + k], model.values, trial.dt)
        errors.append(x[:, 1] - trial.states[20:, 1])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def test_a_curve_predicts_what_no_effect_of_the_library_does():
    model, trials = pushed_cart(dead=0.25, trials=5, seed=1)
    others = [f.name for f in Library().families if f.name not in FEW]
    found = diagnose(model, trials, DiagnosisOptions(library=Library().without(others)))
    left = found.correction
    assert left is not None and left.adoptable and left.held_out_gain > 0.3
    assert (left.channel, left.over) == ("v", ("u",)) and left.unit == "m/s^2"
    assert len(left.curves[0].at) == len(left.curves[0].value) == len(left.curves[0].std)
    again = Diagnosis.from_json(json.loads(json.dumps(found.to_json())))
    assert again.correction == left

    calibrated = model.with_values({n: e.value for n, e in found.parameters.items()})
    better = calibrated
    for curve in left.curves:
        assert found.values(curve.effect) == curve.quantities
        better = wrap(Library().effect(curve.effect, better), curve.quantities, trials[0].dt)
    fresh = pushed_cart(dead=0.25, trials=4, seed=9)[1]
    assert one_second(better, fresh) < 0.7 * one_second(calibrated, fresh)


def test_where_nothing_is_left_there_is_no_correction():
    model, trials = pushed_cart(trials=4)
    assert diagnose(model, trials).correction is None


def kept(folder, **changes):
    """A diagnosis of a workspace with a correction over two variables."""
    ends = {"lo": -1.0, "hi": 1.0} | {f"w{k}": 0.1 * k for k in range(7)}
    curves = tuple(Curve(f"correction:v<-{r}", r, quantities=ends) for r in ("x", "force"))
    values = {"held_out_gain": 0.5, "adoptable": True} | changes
    left = Correction("v", ("x", "force"), unit="m/s^2", curves=curves, **values)
    found = Diagnosis(Verdict("unknown"), correction=left)
    (folder / "reports").mkdir(exist_ok=True)
    write_document(folder / "reports" / "diagnosis.json", found.to_json())


@pytest.mark.parametrize("asked", ["correction:v", "correction:v<-x"])
def test_a_correction_is_adopted_as_part_of_the_model(workspace_of, asked):
    workspace = Workspace(workspace_of().folder)
    workspace.learn(trials=2)
    kept(workspace.folder, adoptable=False)
    with pytest.raises(GroundedError, match="does not predict"):
        workspace.adopt(asked)
    kept(workspace.folder)
    done = workspace.adopt(asked)
    names = [effect["name"] for effect in done.effects]
    assert names == ["correction:v<-x", "correction:v<-force"] and done.claimed
    again = Workspace(workspace.folder)
    assert [e["w6"] for e in again.config.model.effects] == [pytest.approx(0.6)] * 2
    assert again.propose().candidate
