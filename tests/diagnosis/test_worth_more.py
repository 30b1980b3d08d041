"""Which decision is written out when the search went on for one more effect."""

from types import SimpleNamespace

import pytest

from grounded.diagnosis import writer as module
from grounded.diagnosis.writer import Writer


def decided(nats, *names):
    effects = tuple(names)
    return SimpleNamespace(nats=nats, hypothesis=SimpleNamespace(effects=effects))


def gain(mean):
    return SimpleNamespace(mean=mean, largest=mean, beyond=lambda scatters, least: mean > least)


@pytest.mark.parametrize(
    ("nats", "names", "mean", "closes", "replaces"),
    [
        (30.0, ("delay",), 0.0, False, True),  # a camera's; a coupling that imitates it came first
        (1.0, ("delay",), 0.0, False, False),  # the two tie
        (30.0, ("delay",), -0.2, False, False),  # likelier, but predictions refuse it
        (30.0, ("delay", "drag"), 0.0, False, False),  # one effect more has to be worth its name
        (30.0, ("delay", "drag"), 0.3, False, True),
        (30.0, ("delay", "drag"), 0.01, True, True),  # or what is told as a gap is gone with it
    ],
)
def test_as_many_effects_that_are_likelier_take_the_place_of_those_found_first(
    monkeypatch, nats, names, mean, closes, replaces
):
    monkeypatch.setattr(module, "closes_the_gap", lambda *_: closes)
    first, later = decided(0.0, "coupling"), decided(nats, *names)
    ruler = SimpleNamespace(
        gain=lambda before, after: gain(mean if after is later else -mean),
        since_outset=lambda fit: 1.0,
    )
    writer, written = object.__new__(Writer), object.__new__(Writer)
    writer.decision, written.decision = (SimpleNamespace(fit=fit) for fit in (later, first))
    writer.ruler, writer.search = ruler, SimpleNamespace(score=lambda fit: fit.nats)
    assert writer.worth_more_than(written) is replaces
