"""The rule that decides what a diagnosis claims, on options made up of evidence and errors."""

import numpy as np
import pytest

from grounded.diagnosis.validation.choose import Comparison, Errors, Option, Rule

TRIALS = 6
COMPARE = Comparison([0], np.full((2, 1), 1e-6), np.arange(TRIALS))
NATS = {}  # evidence by option


def option(causes, nats, rms, order=0, scatter=0.0):
    """A set of causes with an rms error, of each trial or differing by `scatter` of it."""
    apart = 1 + scatter * np.cos(np.arange(TRIALS) * 2.5)
    total = np.tile((np.array(rms) * apart) ** 2, (2, 1))[..., None]
    errors = Errors(total, np.ones_like(total))
    made = Option(frozenset(causes.split()), errors, order)
    NATS[made] = nats
    return made


def chosen(*options, held_out=True):
    known = {one.causes: one for one in options}

    def less(one, cause):
        return known.get(one.causes - {cause})

    def nats(before, after):
        return NATS[after] - NATS[before]

    return Rule(options, COMPARE, nats, less, held_out=held_out).choose()


NONE = option("", 0.0, 1.0)
DRAG, BIAS = option("drag", 80.0, 0.3), option("bias", 30.0, 0.8)


@pytest.mark.parametrize(
    ("options", "causes"),
    [
        ([NONE], ""),
        ([NONE, DRAG], "drag"),
        ([NONE, option("drag", 2.0, 0.3)], ""),  # predicts well by chance
        ([NONE, option("drag", 80.0, 1.0)], ""),  # likely, and of no use
        ([NONE, option("drag", 80.0, [0.1, 1, 1, 1, 1, 1])], ""),  # in one trial only
        ([NONE, DRAG, BIAS, option("bias drag", 110.0, 0.1)], "bias drag"),
        ([NONE, DRAG, BIAS, option("bias drag", 81.0, 0.1)], "drag"),  # one is not needed
        ([NONE, DRAG, BIAS, option("bias drag", 110.0, 0.299)], "drag"),  # as good without
        ([NONE, DRAG, option("bias drag", 110.0, 0.1)], "drag"),  # the rest was never fitted
        ([NONE, DRAG, option("lag", 85.0, 0.301)], "lag"),  # as small and as good: the likelier
        ([NONE, DRAG, option("lag", 85.0, 0.5)], "drag"),  # likelier, and predicts worse
        # nothing is named that predicts worse than the calibrated model
        ([NONE, DRAG, option("calibration", 70.0, 0.2)], "calibration"),
        (
            [NONE, DRAG, option("calibration", 70.0, 0.2), option("calibration drag", 82.0, 0.15)],
            "calibration drag",
        ),
        ([NONE, DRAG, option("calibration", 90.0, 0.2)], "calibration"),
        ([NONE, option("drag", 80.0, 0.3, order=1), option("mass", 78.0, 0.3)], "mass"),
        ([NONE, option("wave", 80.0, 0.3, order=2), option("drag", 78.0, 0.3, order=1)], "drag"),
        ([NONE, option("wave", 90.0, 0.3, order=2), option("drag", 78.0, 0.3, order=1)], "wave"),
    ],
)
def test_the_smallest_supported_set_that_predicts_as_well_is_chosen(options, causes):
    assert chosen(*options).chosen.causes == set(causes.split())


def test_what_the_reference_has_more_is_told():
    whole = option("bias drag", 110.0, 0.1)
    found = chosen(NONE, DRAG, BIAS, whole)
    assert found.reference is whole and found.lost == 0.0
    scattered = option("bias drag", 110.0, 0.29, scatter=0.2)
    found = chosen(NONE, DRAG, BIAS, scattered)
    assert found.chosen is DRAG and found.lost <= max(found.standard_error, 0.05)


def test_without_anything_held_out_evidence_decides():
    found = chosen(NONE, option("drag", 80.0, 2.0), held_out=False)
    assert found.chosen.causes == {"drag"}


def test_a_gain_of_one_channel_is_not_lost_among_the_others():
    compare = Comparison(range(12), np.full((2, 12), 1e-6), np.arange(TRIALS))
    noise = np.random.default_rng(0).uniform(0.7, 1.4, (2, TRIALS, 12))
    before = Errors(np.ones_like(noise), np.ones_like(noise))
    after = noise.copy()
    after[..., 3] = 0.2
    assert compare(before, Errors(after, before.count)).pays
    assert not compare(before, Errors(np.ones_like(noise), before.count)).pays
