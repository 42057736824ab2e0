"""Rivals of an effect: what is but another way of saying it is none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis, hypotheses, with_shape
from hydrotele.gap import rivals
from hydrotele.gap.rivals import brings_no_more, is_case_of, part_taken, telling, worth_naming
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data


@pytest.fixture(scope="module")
def evidence():
    machine = load_machine("cat215")
    data, _ = machine_data(machine, machine)
    found = Evidence(data, data.fit, 1)
    found.set_base(Guess())
    yield found
    found.close()


@pytest.mark.parametrize(
    ("name", "other", "case"),
    [
        ("valve_deadband", "valve_deadband_direction", True),
        ("valve_gain", "valve_gain_direction", True),
        ("valve_deadband", "valve_gain_direction", False),
        ("valve_gain", "flow_curve", False),
    ],
)
def test_a_number_is_a_case_of_its_numbers_by_direction(evidence, name, other, case):
    table = {h.key: h for h in hypotheses(evidence.data.machine)}
    guess = Guess(((table[name, "stick"], np.ones(1)),))
    assert is_case_of(evidence, guess, 0, table[other, "stick"]) is case


@pytest.mark.nightly
@pytest.mark.parametrize(("bands", "more"), [((0.07, 0.07), False), ((0.05, 0.09), True)])
def test_numbers_by_direction_are_asked_where_the_directions_differ(bands, more):
    """An effect that was fitted, beside the same with two numbers, from there on."""
    model = load_machine("cat215")
    values: dict[str, float] = {"positive": bands[0], "negative": bands[1]}
    data, _ = machine_data(model, apply_effect(model, "valve_deadband_direction", "stick", values))
    table = {h.key: h for h in hypotheses(model)}
    evidence = Evidence(data, data.fit, 1)
    try:
        guess = Guess(((table["valve_deadband", "stick"], np.ones(1)),))
        evidence.set_base(Guess())
        now = evidence.set_base(evidence.fit(guess, 0.0).guess)
        other = table["valve_deadband_direction", "stick"]
        assert brings_no_more(evidence, now, 0, other) is not more
        assert not brings_no_more(evidence, now, 0, table["flow_curve", "stick"])
    finally:
        evidence.close()


@pytest.mark.parametrize(("gap", "worth"), [(1.8e-4, False), (1.2e-3, True)])
def test_what_shapes_an_effect_does_not_make_it_one(gap, worth):
    """A gap of a fifth of the least with a drive that is lighter and damped: a spring, no teeth."""
    machine = load_machine("cat215")
    (teeth,) = (h for h in hypotheses(machine, ("backlash",)) if h.location == "swing")
    whole = with_shape(teeth, machine)
    assert isinstance(whole, Hypothesis) and whole.size > teeth.size
    deviation = np.array([gap / whole.parameters["gap"].prior_std, -0.9, 3.0, 0.0])
    assert worth_naming(Guess(((whole, deviation),)), 0, 1e4) is worth


def test_an_effect_without_optional_numbers_has_no_other_shape():
    (offset, *_) = hypotheses(load_machine("cat215"), ("angle_offset",))
    assert with_shape(offset, load_machine("cat215")) is None


@pytest.mark.parametrize(("after", "ideal", "part", "told"), [
    (900.0, 0.0, 0.1, False),  # a tenth of what is lacking: others do nine of it
    (800.0, 0.0, 0.2, True),
    (900.0, 880.0, 100 / 120, True),  # as little, but nearly nothing is left
    (900.0, 950.0, 1.0, True),  # nothing is lacking any more
    (1010.0, 0.0, -0.01, False),  # worse
])  # fmt: skip
def test_what_takes_little_of_what_is_lacking_is_not_added(monkeypatch, after, ideal, part, told):
    monkeypatch.setattr(rivals, "undisturbed_loss", lambda track: track.ideal)
    tracks: Any = (SimpleNamespace(ideal=0.25 * ideal), SimpleNamespace(ideal=0.75 * ideal))
    now, more = Judged(Guess(), (), 1000.0), Judged(Guess(), tracks, after)
    assert part_taken(now, more) == pytest.approx(part)
    assert telling(now, more) is told


def test_a_number_that_becomes_an_effect_need_not_make_the_loss_smaller(monkeypatch):
    """It saves what it cost to be that far off; nothing is lacking before or after."""
    monkeypatch.setattr(rivals, "undisturbed_loss", lambda track: 1010.0)
    track: Any = None
    now, after = Judged(Guess(), (track,), 1000.0), Judged(Guess(), (track,), 1002.0)
    assert not telling(now, after)
    assert telling(now, after, 30.0)
