"""Options given in Python are checked as those in grounded.toml and on the command line."""

import pytest

import grounded as gr
from facts import holding
from grounded.diagnosis.diagnose import DiagnosisOptions


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
