"""The public Python API: the ask-and-tell search, its options, results shown in a notebook."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from facts import holding
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.plant import Plant
from grounded.search.improve import propose
from small_tasks import drive, other, rover_task

TASK = rover_task()
PLANT = Plant(other(TASK.model, 1.15), latency={"speed": 0.06, "turn": 0.06})
OPTIONS = gr.SearchOptions(max_trials=12)


def run(candidate):
    return drive(TASK, PLANT, candidate)


def numbers(candidates):
    parts = [
        (c.policy.feedforward, c.policy.gain, c.policy.reference, c.predicted_states, c.alpha)
        for c in candidates
    ]
    return [np.asarray(array).tobytes() for part in parts for array in part]


@pytest.fixture(scope="module")
def search():
    return gr.learn(TASK, run, OPTIONS)


def test_ask_and_tell_give_the_candidates_of_propose_bit_for_bit(search):
    candidates, trials = [], []
    while (proposal := propose(TASK, candidates, trials, OPTIONS)).candidate is not None:
        candidates += [proposal.candidate] * proposal.is_new
        trials.append(run(proposal.candidate))
    asked = gr.Search(TASK, OPTIONS)
    while (candidate := asked.ask()) is not None:
        assert asked.ask() is candidate and asked.standing.phase == "await-trial"
        asked.tell(replace(run(candidate), candidate=""))
    assert len(candidates) > 2
    assert numbers(candidates) == numbers(asked.candidates) == numbers(search.candidates)
    ends = [found.standing.to_json() for found in (proposal, asked, search)]
    assert ends[0] == ends[1] == ends[2]


def test_a_search_goes_on_from_its_candidates_and_trials(search):
    half = gr.Search(TASK, OPTIONS, candidates=search.candidates[:2], trials=search.trials[:2])
    assert numbers([half.ask()]) == numbers([search.candidates[2]])


@pytest.mark.slow
def test_a_search_goes_on_with_effects_that_have_a_memory():
    """An adopted delay becomes latency, a lag a memory state of the planning model."""
    begun = gr.Search(TASK, OPTIONS)
    begun.tell(run(begun.ask()))
    delays = {"delay:speed": {"d": 0.01}, "delay:turn": {"d": 0.04}}  # the plant's, less the task's
    late = begun.adopt(delays)
    lagging = begun.adopt({"first_order_lag:turn": {"tau": 0.06}})
    assert np.allclose(late.planner.plan.latency, 0.06) and (late.task.latency < 0.06).all()
    assert lagging.planner.plan.model.n == TASK.model.n + 1
    for search in (late, lagging):
        candidate = search.ask()
        assert candidate.base == "c0001" and candidate.model != begun.candidates[0].model
        search.tell(run(candidate))
        assert search.trials[1].states.shape[1] == TASK.model.n
    told = [late.planner.lift(trial) for trial in late.trials]
    assert abs(late.candidates[1].predicted_utility - late.task.utility(late.trials[1])) < abs(
        begun.candidates[0].predicted_utility - TASK.utility(told[0])
    )
    name = next(iter(TASK.model.params))
    value = 1.01 * TASK.model.params[name].value
    assert begun.adopt({}, {name: value}).planner.plan.model.params[name].value == value
    with pytest.raises(gr.GroundedError, match="spede"):
        begun.adopt({"delay:spede": {"d": 0.06}})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"candidate": "c0009"}, ["no candidate 'c0009'", "c0001"]),
        ({"candidate": ""}, ["no candidate is waiting"]),
        ({"dt": 0.1, "candidate": "c0001"}, ["dt", "0.05", "0.1"]),
        ({"input_names": ("turn", "speed"), "candidate": "c0001"}, ["inputs", "turn", "speed"]),
    ],
)
def test_a_trial_that_is_none_of_this_search_is_refused(change, said):
    asked = gr.Search(TASK)
    trial = run(asked.ask())
    asked.tell(trial)
    with pytest.raises(gr.GroundedError) as error:
        asked.tell(replace(trial, **change))
    assert all(word in str(error.value) for word in said) and asked.trials == (trial,)


def test_fit_stays_the_function_after_its_room_was_imported():
    import grounded.fit  # noqa: F401

    assert callable(gr.fit) and gr.fit.__name__ == "fit"
    assert set(gr.__all__) <= set(dir(gr))
    with pytest.raises(AttributeError, match=holding("'fitt'")):
        gr.fitt  # noqa: B018


def test_the_front_door_opens_at_once():
    code = "import sys, grounded; print(' '.join(m for m in sys.modules if '.' not in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "scipy", "llvmlite"} & set(done.stdout.split())


def test_what_a_user_gets_wrong_in_python_is_said():
    model, n = TASK.model, TASK.model.n
    reward, trial = TASK.reward, run(gr.Search(TASK).ask())
    two = replace(model, derivative=lambda s, a: dict.fromkeys(model.states, 0.0))
    for mistake, told in (
        (lambda: replace(reward, state={"x": 3.0}), holding("[reward] state", "array of numbers")),
        (
            lambda: replace(TASK, reward=replace(reward, state=np.ones(n + 1))),
            holding("[reward] state", f"({n},)"),
        ),
        (lambda: replace(TASK, start="here"), holding("task: start", "array of numbers")),
        (lambda: gr.Model(states=["x"], inputs={"u": "N"}, derivative=len), "dict by name"),
        (lambda: gr.diagnose([], TASK), holding("model", "Task or Model", "list")),
        (lambda: gr.diagnose(model, run(gr.Search(TASK).ask())), "Trial"),
        (lambda: gr.diagnose(model, [np.zeros((3, n))]), "list of ndarray"),
        (lambda: gr.fit(model, [np.zeros((3, n))]), "ndarray"),
        (lambda: gr.Search(model), holding("task", "a Task", "a Model")),
        (lambda: gr.Search(TASK).tell(np.zeros((3, n))), "ndarray"),
        (
            lambda: TASK.utility(replace(trial, state_names=trial.state_names[::-1])),
            "in this order",
        ),
        (lambda: gr.Search(replace(TASK, model=two)).ask(), r"\(s, a, p\)"),
        (lambda: gr.learn(TASK, lambda candidate: None), holding("gr.Trial", "NoneType")),
        (lambda: gr.learn(TASK, lambda candidate: "run.mcap"), holding("gr.Trial", "a str")),
        (lambda: gr.learn(TASK, "drive.py"), holding("run", "function", "a str")),
        (lambda: gr.learn(TASK, run, 5), holding("options", "SearchOptions", "a int")),
        (lambda: gr.learn(TASK, run, max_iterations="3"), "max_iterations"),
        (lambda: gr.Search(TASK).tell("run.mcap"), "read_trial"),
        (lambda: gr.Search(TASK, trials=trial), holding("trials", "list of Trials", "a Trial")),
        (
            lambda: gr.Search(TASK, candidates=[trial]),
            holding("Candidates", "list of Trial"),
        ),
        (lambda: gr.Search(TASK).adopt(["delay:u"]), "Diagnosis.joining"),
        (lambda: gr.Search(TASK).adopt({"delay:u": 0.1}), "Diagnosis.joining"),
        (lambda: gr.Search(TASK).adopt({}, [1.0]), holding("params", "dict")),
        (lambda: gr.diagnose(TASK, [trial], 3), "DiagnosisOptions"),
        (lambda: gr.fit([trial], TASK), holding("model", "Model or Task", "a list")),
        (lambda: gr.fit(model, None), holding("list of Trials", "a NoneType")),
        (lambda: gr.fit(model, [trial], 3), holding("names", "list of names", 3)),
        (lambda: propose(TASK, [], trial, OPTIONS), holding("list of Trials", "a Trial")),
        (lambda: propose(TASK, [], [], None), "SearchOptions"),
        (lambda: TASK.utility("run.mcap"), holding("a Trial", "a str")),
        (lambda: replace(trial, state_names=None), holding("state_names", "list of names")),
    ):
        with pytest.raises(gr.GroundedError, match=told):
            mistake()


def test_results_are_one_line_a_table_and_a_document(search):
    fitted = gr.fit(TASK, search.trials[:1], ["gain"])
    found = [search.standing, search.best, search.best.candidate, search.proposal, fitted]
    for result in found:
        shown = repr(result)
        assert "\n" not in shown and len(shown) < 120 and type(result).__name__ in shown
        assert "<table>" in result._repr_html_()
        assert json.loads(json.dumps(result.to_json(), allow_nan=False)) == result.to_json()
    assert search.best.candidate.id in repr(search.standing)
    assert len(repr(search)) < 80


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"method": "dpp"}, ("method", "'dpp'", "'ddp'")),
        ({"step": "ful"}, ("step", "'ful'", "'full'")),
        ({"step": None}, ("step", "damped", "full")),
        ({"repeats": "2"}, ("repeats", "'2'", "100")),
        ({"repeats": 2.5}, ("repeats", "2.5")),
        ({"repeats": True}, ("repeats", "True")),
        ({"max_trials": 0}, ("max_trials", "1", "0")),
        ({"tolerance": "a"}, ("tolerance", "'a'", "from 0 below 1")),
        ({"tolerance": float("nan")}, ("tolerance", "nan")),
        ({"refit": "no"}, ("refit", "'no'", "False")),
    ],
)
def test_wrong_options_of_a_search(given, facts):
    with pytest.raises(gr.GroundedError, match=holding(*facts)):
        gr.SearchOptions(**given)


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"max_effects": 13}, ("max_effects", "1", "12", "13")),
        ({"max_effects": 0}, ("max_effects", "1", "12", "0")),
        ({"max_effects": "1"}, ("max_effects", "'1'")),
        ({"library": ["delay"]}, ("library", "list")),
    ],
)
def test_wrong_options_of_a_diagnosis(given, facts):
    with pytest.raises(gr.GroundedError, match=holding(*facts)):
        DiagnosisOptions(**given)
